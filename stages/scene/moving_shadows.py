"""Evidence of light that changes from place to place and over time, as where shadows of movers pass, and the decision.

A change of exposure acts on the whole picture. A shadow that passes darkens a point and its neighbours for some frames.
So the change of two of four neighbours in the frames before and after predicts that of the others, as it will predict
frames that are not trained on. Other light that comes and goes in one place counts as well.
"""

from typing import Any

import numpy as np

from stages.scene.light_model import Light
from stages.scene.photometry import GREY_LEVELS, by_view, view_groups
from stages.scene.rules import Choice, light_decision, saves
from stages.scene.sightings import GROUP, Sightings
from stages.scene.weigh import NOTHING, Bought, weigh
from stages.shared.light import LIGHT_CHANGES

DENSITY = 4
"""Shadows fall on a small part of the scene: so many times as many points as for the light of the whole."""
HALVES = ((0, 3), (1, 2)), ((1, 2), (0, 3))
"""Of four neighbours, those that are predicted, and by which."""
REFITS = 3
"""Times that the change with the view is fitted without the frames in which it leaves a change of light."""


def shadow_evidence(seen: Sightings, fitted: Light, degree: int = 0) -> Bought:
    """What changes over time save that neighbours show one training frame before and after, in grey levels.

    They count where both neighbours change by more than LIGHT_CHANGES, to the same side; elsewhere the light is steady.
    A highlight passes over a surface like a shadow. So what the view explains is taken out first, where it is modelled.

    Args:
        degree: of the harmonics by which colours depend on the view; 0 if they do not.
    """
    colours, directions, usable = view_groups(seen, fitted)
    kept = np.flatnonzero(usable.any(axis=2).sum(axis=1) == GROUP)
    colours, directions, usable = colours[kept], directions[kept], usable[kept]
    if not len(usable) or usable.shape[2] < 3:
        return NOTHING
    if degree:
        colours = colours - _by_view(colours, directions, usable, degree)
    colours = np.where(usable[..., None], GREY_LEVELS * colours, np.nan)
    change = colours - np.nanmedian(colours, axis=2, keepdims=True)
    steady, moving, groups = [], [], []
    for rows, others in HALVES:
        light = change[:, others].mean(axis=-1)
        agree = (np.abs(light).min(axis=1) > GREY_LEVELS * LIGHT_CHANGES) & (light[:, 0] * light[:, 1] > 0)
        shown = np.where(agree[..., None], change[:, others].mean(axis=1), 0.0)
        predicted = (shown[:, :-2] + shown[:, 2:]) / 2
        known = np.logical_and(*(usable[:, other] for other in others))
        for row in rows:
            own = change[:, row, 1:-1]
            judged = known[:, :-2] & known[:, 2:] & usable[:, row, 1:-1]
            steady.append(own[judged].ravel())
            moving.append((own - predicted)[judged].ravel())
            groups.append(np.repeat(np.nonzero(judged)[0], 3))
    errors = np.concatenate(steady), np.concatenate(moving)
    return weigh(*errors, np.concatenate(groups), trimmed=False)


def _by_view(colours: np.ndarray, directions: np.ndarray, usable: np.ndarray, degree: int) -> np.ndarray:
    """How colours change with the view, [g, GROUP, F, 3], in frames in which no shadow is seen to pass over a group."""
    lit = usable
    for _ in range(REFITS):
        left = np.where(usable[..., None], colours - by_view(colours, directions, usable, lit, degree), np.nan)
        change = np.where(usable[..., None], left - np.nanmedian(left, axis=2, keepdims=True), 0)
        shared = change.sum(axis=(1, 3)) / np.maximum(3 * usable.sum(axis=1), 1)
        lit = usable & (np.abs(shared) < LIGHT_CHANGES)[:, None]
    return by_view(colours, directions, usable, lit, degree)


def decide_moving_shadows(bought: Bought, choice: Choice) -> dict[str, Any]:
    """The entry of scene.json: the same must be saved as by gains."""
    why = f"the change that neighbours show in the frames around {saves(bought, 'grey levels')}"
    return light_decision(bought, False, {}, why, choice)
