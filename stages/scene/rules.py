"""Decisions from evidence, with their thresholds and the reasons for these."""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

MIN_MASK_SHARE = 5e-4
"""A mask of less than this share of the pixels is noise of the refinement: 56 px of a 512 x 218 frame."""
RIGID_RATIO, RIGID_SLACK_PX = 1.2, 0.2
"""Masked pixels that fit the static scene about as well as the others are false positives."""
MIN_PARALLAX_PX = 1.0
"""Parallax below one pixel between the most distant frames does not separate depths from infinity."""
MIN_GAIN_PERCENT, MIN_GAIN_SIGMAS = 3.0, 4.0
"""A gain below 3 per cent is invisible and costs less than 0.1 dB at 30 dB."""
MIN_PREDICTED_CHANGE, MIN_PREDICTED_SHARE = 0.01, 0.25
"""View dependence must predict 2.5 grey levels, and a quarter of the change; a degree more, another tenth."""
MIN_SECOND_DEGREE_SHARE = 0.1
MIN_BENDING_PX, MIN_BENDING_SHARE = 0.25, 0.15
"""Flow between neighbouring frames has errors of about a quarter of a pixel."""
RIGID_POINTS, BENDING_POINTS = 256, 512
RIGID_ARAP, BENDING_ARAP = 0.5, 0.05
"""Held-out PSNR hardly depends on the number of points; on non-rigid movers a strong rigidity costs up to 0.9 dB."""

Choice = Literal["auto", "yes", "no"]


def decide_dynamic(evidence: dict[str, float], choice: Choice) -> dict[str, Any]:
    """Moving parts: masks that are not empty and whose flow a static scene does not explain."""
    share, inside, outside = (evidence[key] for key in ("mask_share", "residual_inside_px", "residual_outside_px"))
    explained = inside <= RIGID_RATIO * outside + RIGID_SLACK_PX
    needed = share >= MIN_MASK_SHARE and not explained
    if share < MIN_MASK_SHARE:
        why = f"the masks cover {share:.2%} of the pixels, less than {MIN_MASK_SHARE:.2%}"
    elif explained:
        why = f"a static scene explains the masked pixels as well as the others: {inside:.2f} px and {outside:.2f} px"
    else:
        why = (
            f"the masks cover {share:.1%}; the residual of a static scene is {inside:.1f} px inside them"
            f" and {outside:.2f} px outside"
        )
    return _decision(needed, evidence, why, choice)


def about_masks(decision: dict[str, Any], trusted: np.ndarray, used: np.ndarray) -> dict[str, Any]:
    """Changes to the decision about moving parts if the pose stage did not trust the masks of some frames [T]."""
    if trusted.all():
        return {}
    frames = f"{(~trusted).sum()} of {len(trusted)} frames"
    kept = "are used all the same, since few others are left" if used.all() else "are left out"
    why = f"{decision['why']}; masks of {frames}, which the pose stage distrusts, {kept}"
    return {"why": why, "masks_distrusted": int((~trusted).sum()), "masks_left_out": int((~used).sum())}


def decide_rotation_only(evidence: dict[str, float], choice: Choice) -> dict[str, Any]:
    """A camera that only turns: hardly any parallax, or the pose stage found none."""
    parallax, marked = evidence["parallax_px"], evidence["frames_marked_share"]
    needed = parallax < MIN_PARALLAX_PX or marked > 0.5
    why = f"static pixels shift by {parallax:.1f} px between the most distant frames (threshold {MIN_PARALLAX_PX} px)"
    if marked > 0:
        why += f"; the pose stage marks {marked:.0%} of the frames as rotation-only"
    return _decision(needed, evidence, why, choice)


def decide_exposure(evidence: dict[str, float], choice: Choice) -> dict[str, Any]:
    """Exposure change: a visible and significant range of the frames' brightness, beyond what fog explains."""
    gain, error = evidence["gain_range_percent"], evidence["standard_error_percent"]
    threshold = max(MIN_GAIN_PERCENT, MIN_GAIN_SIGMAS * error)
    near, far = evidence["near_range_percent"], evidence["far_range_percent"]
    why = (
        f"beside what fog explains, near and far static pixels share a brightness range of {gain:.1f} +- {error:.1f} %"
        f" (threshold {threshold:.1f} %; alone {near:.1f} % and {far:.1f} %)"
    )
    return _decision(gain >= threshold, evidence | {"threshold_percent": threshold}, why, choice)


def decide_view_dependent(evidence: dict[str, float], choice: Choice) -> dict[str, Any]:
    """View-dependent colour, with the degree of the spherical harmonics: 0 where it is not needed."""
    first, second = evidence["gain_degree1"], evidence["gain_degree2"]
    share = max(first, second)
    change = evidence["colour_change"] * max(share, 0.0) ** 0.5
    needed = change >= MIN_PREDICTED_CHANGE and share >= MIN_PREDICTED_SHARE
    why = (
        f"the viewing direction predicts {max(share, 0):.0%} of the colours' change, {255 * change:.1f} grey levels,"
        f" over {evidence['view_angle_deg']:.0f} degrees (thresholds {MIN_PREDICTED_SHARE:.0%},"
        f" {255 * MIN_PREDICTED_CHANGE:.1f})"
    )
    decision = _decision(needed, evidence, why, choice)
    degree = 2 if second - first >= MIN_SECOND_DEGREE_SHARE else 1
    return decision | {"sh_degree": degree if decision["needed"] else 0}


def decide_non_rigid(
    evidence: dict[str, float], instances: Mapping[int, dict[str, float]], choice: Choice
) -> dict[str, Any]:
    """Non-rigid movers: the residual of a rigid plane's flow is large in px and relative to the spread of the flow.

    Args:
        evidence: of all movers, which decides; instances: of each, which gives it a label of its own.
    """
    bending, spread = evidence["bending_px"], evidence["flow_spread_px"]
    needed = _bends(evidence)
    why = (
        f"residual of rigid motion of each region {bending:.2f} px, spread of its flow {spread:.2f} px"
        f" (thresholds {MIN_BENDING_PX} px, {MIN_BENDING_SHARE:.0%})"
    )
    decision = _decision(needed, evidence, why, choice)
    bends = decision["needed"]
    return decision | {
        "arap_weight": BENDING_ARAP if bends else RIGID_ARAP,
        "points": BENDING_POINTS if bends else RIGID_POINTS,
        "instances": {str(n): {"label": "bending" if _bends(of) else "rigid", **of} for n, of in instances.items()},
    }


def _bends(evidence: dict[str, float]) -> bool:
    bending = evidence["bending_px"]
    return bending >= MIN_BENDING_PX and bending >= MIN_BENDING_SHARE * evidence["flow_spread_px"]


def _decision(needed: bool, evidence: dict[str, float], why: str, choice: Choice) -> dict[str, Any]:
    """The entry of scene.json; the user's choice overrules the evidence, which stays on record."""
    if choice != "auto":
        return {"needed": choice == "yes", "evidence": evidence, "why": f"set by the user; {why}", "source": "user"}
    return {"needed": bool(needed), "evidence": evidence, "why": why, "source": "evidence"}
