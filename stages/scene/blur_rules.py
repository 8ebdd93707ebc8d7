"""The decision about motion blur, with its thresholds and the reasons for these."""

from typing import Any

from stages.scene.rules import Choice
from stages.scene.weigh import SIGNIFICANT

MIN_SPEED_PX = 1.5
"""Below this speed per frame no shutter smears anything visibly."""
MAX_SLOPE_SIGMA = 1 / 3
"""Above, a shutter open for half of the time cannot be told from one that smears nothing, at three deviations."""
MIN_AGREEMENT = 0.5
"""Below, the speeds of a point differ between frames by no more than the errors of the flow."""
MIN_GAIN_PERCENT, MIN_SIGMAS, MIN_SMEAR_PX = 0.3, 3.0, 1.0
"""Without blur the gain was at most 0.04 per cent, on the tuned scenes where it is observable. Its mean there is as far
below zero as a right shutter is above: it must be MIN_SIGMAS standard errors above that mean, not above zero."""
USUAL_SHUTTER = 0.5
"""Of cameras for film, in frames: what is used if the user wants blur where the shutter is not observable."""


def is_ruled_out(evidence: dict[str, float]) -> bool:
    """Whether there is clearly no blur: what it predicts is MIN_SIGMAS standard errors below the least gain.

    Where the fitted shutter is 0, gain and standard error are 0: then `slope_sigma` alone says how sure that is.

    Args:
        evidence: of pixels that were compared: without any, all of it is 0.
    """
    most = evidence["gain_percent"] + MIN_SIGMAS * evidence["gain_sigma_percent"]
    return most < MIN_GAIN_PERCENT and evidence["slope_sigma"] <= MAX_SLOPE_SIGMA


def decide_motion_blur(evidence: dict[str, float], choice: Choice, given: float | None) -> dict[str, Any]:
    """The entry of scene.json, with the shutter in frames: None where motion blur is not modelled.

    The statistic is the share of the squared difference between frames that the blur predicts where it was not fitted.

    Args:
        evidence: of `shutter.shutter_evidence`. given: the user's shutter.
    """
    names = ("gain_percent", "gain_sigma_percent", "expected_percent")
    speed, (gain, sigma, expected) = evidence["speed_px"], (evidence.get(name, 0.0) for name in names)
    observable = evidence.get("speed_agreement", 0.0) >= MIN_AGREEMENT and evidence["slope_sigma"] <= MAX_SLOPE_SIGMA
    smear = evidence.get("shutter", 0.0) * speed
    threshold = max(MIN_GAIN_PERCENT, MIN_SIGMAS * sigma - expected)
    needed = gain >= threshold and smear >= MIN_SMEAR_PX
    if speed < MIN_SPEED_PX:
        why = f"not observable: nothing moves faster than {speed:.1f} px per frame (threshold {MIN_SPEED_PX} px)"
    elif not observable and given is None:
        why = "not observable: the same points have nearly the same speed in all frames"
    else:
        why = (
            f"a shutter open for {evidence.get('shutter', 0.0):.2f} +- {evidence.get('shutter_sigma', 0.0):.2f} frames,"
            f" {smear:.1f} px, predicts {gain:.1f} +- {sigma:.1f} % of the difference between frames where it was not"
            f" fitted (thresholds {MIN_SMEAR_PX} px, {threshold:.1f} %)"
        )
    needed = needed and (observable or given is not None)
    measured = evidence["shutter"] if observable and evidence["shutter"] > 0 else USUAL_SHUTTER
    overruled = choice != "auto"
    modelled = choice == "yes" if overruled else needed
    return {
        "needed": modelled,
        "statistic": gain,
        "interval": [gain - SIGNIFICANT * sigma, gain + SIGNIFICANT * sigma],
        "threshold": threshold,
        "unit": "% of the difference",
        "evidence": evidence,
        "why": f"set by the user; {why}" if overruled else why,
        "source": "user" if overruled else "evidence",
        "observable": observable,
        "shutter": (measured if given is None else given) if modelled else None,
    }
