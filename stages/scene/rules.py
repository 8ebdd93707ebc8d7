"""Decisions from evidence, with their thresholds and the reasons for these.

An effect is decided by what its model saves on samples that it was not fitted to, in the unit of the errors.
"""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from stages.scene.bending import Bending
from stages.scene.geometry import MaskEvidence
from stages.scene.photometry import (
    LEAST_FOG_GREY,
    LEAST_FOG_SHARE,
    LEAST_GREY,
    LEAST_SHARE,
    MIN_DISTANCE_CHANGE,
    LightEvidence,
    ViewEvidence,
    is_worth,
)
from stages.scene.weigh import NOTHING, SIGNIFICANT, Bought

MIN_MASK_SHARE = 5e-4
"""A mask of less than this share of the pixels is noise of the refinement: 56 px of a 512 x 218 frame."""
MIN_MOTION_PX, MIN_MOTION_SHARE = 0.15, 0.4
"""Masked pixels that fit the static scene about as well as a motion of their own are false positives. A rigid plane
saves least of what bends and fills the view: .45 in all_moving, .59 in breathing_wall, .85 and more in all others."""
MIN_TRAVEL_PX, MIN_TRAVEL_SHARE = 0.05, 0.2
"""Travel that explains less than the errors of the flow does not separate depths from infinity."""
MIN_VIEW_GREY, MIN_VIEW_SHARE = 1.2, 0.4
"""Harmonics make the model two or three times as large; a degree more must save another tenth of the change. Of tuned
scenes without highlights, the shade of all_moving saves 1.0, errors of pose and depth up to 0.8; highlights over 10
degrees save 1.3 on grove."""
MIN_SECOND_DEGREE_SHARE = 0.1
MIN_VIEW_DEG = 0.5
"""Median range of the views. The direction to a highlight's middle turns by half of it, less than the sun is wide: what
changes over so few views changes with time."""
MIN_BENDING_PX, NOISE_FACTOR = 0.08, 2.0
"""Over frames up to five apart: an edge of ten grey levels per pixel is wrong by about one. Single boxes reach 0.02
(tuned scenes), a ball that rolls by 10 degrees per frame 0.04, blocks that come apart 0.22. Factor: over the same on
static patches, which do not bend."""
RIGID_ARAP, BENDING_ARAP = 0.5, 0.05
"""On non-rigid movers a strong rigidity costs up to 0.9 dB of held-out PSNR."""

Choice = Literal["auto", "yes", "no"]
Decision = dict[str, Any]


def decide_dynamic(evidence: MaskEvidence, choice: Choice) -> Decision:
    """Moving parts: masks that are not empty, whose flow their own motion predicts better than a static scene.

    To model a moving part as static costs far more than the reverse: chance counts for the movers.
    """
    bought, share = evidence.bought, evidence.share
    few = share < MIN_MASK_SHARE
    needed = not few and bought.size >= MIN_MOTION_PX and bought.share >= MIN_MOTION_SHARE
    residuals = f"{evidence.inside_px:.2f} px inside them and {evidence.outside_px:.2f} px outside"
    if few:
        why = f"the masks cover {share:.2%} of the pixels, less than {MIN_MASK_SHARE:.2%}"
    elif needed:
        why = f"the masks cover {share:.1%}; {saves(bought, 'px')}; the residual of a static scene is {residuals}"
    else:
        why = f"a static scene explains the masked pixels as well as the others: {saves(bought, 'px')}; {residuals}"
    numbers = {"mask_share": share}
    numbers |= {"residual_inside_px": evidence.inside_px, "residual_outside_px": evidence.outside_px}
    return _decision(needed, bought, MIN_MOTION_PX, "px", numbers, why, choice)


def about_masks(decision: Decision, trusted: np.ndarray, used: np.ndarray) -> Decision:
    """Changes to the decision about moving parts if the pose stage did not trust the masks of some frames [T]."""
    if trusted.all():
        return {}
    frames = f"{(~trusted).sum()} of {len(trusted)} frames"
    kept = "are used all the same, since few others are left" if used.all() else "are left out"
    why = f"{decision['why']}; masks of {frames}, which the pose stage distrusts, {kept}"
    return {"why": why, "masks_distrusted": int((~trusted).sum()), "masks_left_out": int((~used).sum())}


def decide_rotation_only(travel: Bought, marked: float, choice: Choice) -> Decision:
    """A camera that only turns: travel explains no more of the flow than turning does, or the pose stage found none.

    Args:
        marked: share of the frames that the pose stage marks as rotation-only.
    """
    travels = travel.reaches(MIN_TRAVEL_PX, MIN_TRAVEL_SHARE)
    why = f"beside turning, travel with depth from other frames {saves(travel, 'px')} of the static flow"
    if marked > 0:
        why += f"; the pose stage marks {marked:.0%} of the frames as rotation-only"
    numbers = {"frames_marked_share": marked}
    return _decision(not travels or marked > 0.5, travel, MIN_TRAVEL_PX, "px", numbers, why, choice)


def decide_exposure(evidence: LightEvidence, choice: Choice) -> Decision:
    """Exposure change: a gain per frame predicts static points that it was not fitted to."""
    bought, gains = evidence.exposure, evidence.fitted.log_gains.mean(axis=1)
    numbers = {"gain_range_percent": 100 * float(np.expm1(np.ptp(gains)))}
    why = f"a gain per frame, beside fog and vignetting, {saves(bought, 'grey levels')}"
    if not bought.samples:
        why = "not observable: no static point is seen unclipped in several frames"
    return light_decision(bought, False, numbers, why, choice)


def decide_white_balance(evidence: LightEvidence, choice: Choice, exposure: Choice = "auto") -> Decision:
    """Changing white balance: a gain per channel predicts static points better than one for all channels.

    Args:
        exposure: the user's choice about exposure. Gains per channel hold it: who rules it out has to ask for them.
    """
    bought, gains = evidence.white_balance, evidence.fitted.log_gains
    tint = gains - gains.mean(axis=1, keepdims=True)
    numbers = {"tint_range_percent": 100 * float(np.expm1(np.ptp(tint, axis=0).max()))}
    why = f"a gain per channel, beside one for all, {saves(bought, 'grey levels')}"
    decision = light_decision(bought, False, numbers, why, choice)
    if exposure != "no" or choice != "auto":
        return decision
    why = f"gains per channel hold the exposure, which the user rules out; {decision['why']}"
    return decision | {"needed": False, "why": why, "source": "user"}


def about_followed(decision: Decision, followed: Bought) -> Decision:
    """Changes to a decision about gains if they do not act on the whole picture: `followed` is what they save there."""
    if not decision["needed"] or decision["source"] != "evidence" or followed.interval[0] > 0:
        return {}
    why = f"where the flow follows the whole picture, movers too, it {saves(followed, 'grey levels')}"
    return {"needed": False, "why": f"{decision['why']}; {why}: not beyond chance"}


def decide_atmosphere(evidence: LightEvidence, choice: Choice) -> Decision:
    """Fog: distance predicts how static points change; with its extinction per scene unit and airlight, linear.

    Where fog is not observable, or the best fog is none at all, there is nothing to model, even if the user asks.
    """
    bought, fitted, change = evidence.atmosphere, evidence.fitted, evidence.distance_change
    why = f"fog, beside gains and vignetting, {saves(bought, 'grey levels')}"
    if change < MIN_DISTANCE_CHANGE:
        why = (
            f"not observable: the distance of static points changes by {change:.1%} while they are seen, less than"
            f" {MIN_DISTANCE_CHANGE:.0%}; {why}"
        )
    decision = light_decision(bought, True, {"distance_change_percent": 100 * change}, why, choice)
    if decision["needed"] and fitted.extinction <= 0:
        found = "no fog is fitted" if change < MIN_DISTANCE_CHANGE else "the fit finds clear air"
        decision |= {"needed": False, "why": f"{decision['why']}; {found}, so nothing is modelled"}
    return decision | {"extinction": fitted.extinction, "airlight": [float(a) for a in fitted.airlight]}


def decide_view_dependent(evidence: ViewEvidence, choice: Choice) -> Decision:
    """View-dependent colour, with the degree of the spherical harmonics: 0 where it is not needed."""
    first, second = evidence.degrees
    observable = first.samples > 0 and evidence.angle_deg >= MIN_VIEW_DEG
    beyond_chance = first.rank_sigmas > SIGNIFICANT
    needed = observable and beyond_chance and first.size >= MIN_VIEW_GREY and first.share >= MIN_VIEW_SHARE
    why = (
        f"the change of neighbours with the view, over {evidence.angle_deg:.0f} degrees, {saves(first, 'grey levels')}"
        f" (at least {MIN_VIEW_SHARE:.0%}); cells that gain outrank the others by {first.rank_sigmas:.1f} standard"
        f" deviations (more than {SIGNIFICANT:g})"
    )
    if not observable:
        why = f"not observable: points are seen over {evidence.angle_deg:.2f} degrees, less than {MIN_VIEW_DEG}; {why}"
    numbers = {
        "share_degree1": first.share,
        "share_degree2": second.share,
        "rank_sigmas": first.rank_sigmas,
        "view_angle_deg": evidence.angle_deg,
    }
    decision = _decision(needed, first, MIN_VIEW_GREY, "grey levels", numbers, why, choice)
    degree = 2 if second.share - first.share >= MIN_SECOND_DEGREE_SHARE else 1
    return decision | {"sh_degree": degree if decision["needed"] else 0}


def decide_non_rigid(instances: Mapping[int, Bending], choice: Choice) -> Decision:
    """Non-rigid movers: a change of shape predicts flow that rigid motion with free depth does not.

    Args:
        instances: what bending buys for each, which gives it a label of its own. Of those that bend, or else of all,
            that for which it saves most is told.
    """
    most = max(
        instances.values(),
        key=lambda of: (_bends(of), of.bought.saved * of.bought.samples),
        default=Bending(NOTHING, None),
    )
    bought, static_px = most
    beside = f"on static patches of its shape {static_px:.2f} px" if static_px is not None else "no such static patch"
    why = (
        f"beside rigid motion with free depth, bending {saves(bought, 'px')} in the mover that it tells most about;"
        f" {beside}"
    )
    decision = _decision(
        _bends(most), bought, _least_bending(most), "px", {"static_patches_px": static_px}, why, choice
    )
    bends = decision["needed"]
    labels = {
        str(n): {
            "label": "bending" if _bends(of) else "rigid",
            "bending_px": of.bought.size,
            "static_patches_px": of.static_px,
        }
        for n, of in instances.items()
    }
    return decision | {
        "arap_weight": BENDING_ARAP if bends else RIGID_ARAP,
        "instances": labels,
    }


def _bends(evidence: Bending) -> bool:
    return evidence.bought.reaches(_least_bending(evidence), 0.0)


def _least_bending(evidence: Bending) -> float:
    """What bending must save at least, in px: where no static patch was measured, MIN_BENDING_PX."""
    return max(MIN_BENDING_PX, NOISE_FACTOR * (evidence.static_px or 0.0))


def light_decision(bought: Bought, fog: bool, evidence: dict[str, float], why: str, choice: Choice) -> Decision:
    """The entry of scene.json of what gains, or fog, must save."""
    grey, share = (LEAST_FOG_GREY, LEAST_FOG_SHARE) if fog else (LEAST_GREY, LEAST_SHARE)
    return _decision(
        is_worth(bought, fog), bought, grey, "grey levels", evidence, f"{why} (at least {share:.0%})", choice
    )


def saves(bought: Bought, unit: str) -> str:
    """What a model saves, in words."""
    if bought == NOTHING:
        return "saves nothing, since nothing is observed"
    low, high = bought.interval
    return f"saves {bought.size:.2f} {unit} ({low:.2f} to {high:.2f}), {max(bought.share, 0):.0%} of the held-out error"


def _decision(
    needed: bool,
    bought: Bought,
    threshold: float,
    unit: str,
    evidence: Mapping[str, float | None],
    why: str,
    choice: Choice,
) -> Decision:
    """The entry of scene.json; the user's choice overrules the evidence, which stays on record."""
    found = {"statistic": bought.size, "interval": list(bought.interval), "threshold": threshold, "unit": unit}
    by_evidence = {"needed": bool(needed), **found, "evidence": {**evidence, "saved_share": bought.share}}
    if choice != "auto":
        return by_evidence | {"needed": choice == "yes", "why": f"set by the user; {why}", "source": "user"}
    return by_evidence | {"why": why, "source": "evidence"}
