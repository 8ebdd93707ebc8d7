"""Evidence of light that changes from place to place and over time, as where shadows of movers pass, and the decision.

A change of exposure acts on the whole picture. A shadow that passes darkens a point and its neighbours for some frames.
So the change of two of four neighbours in the frames before and after predicts that of the others, as it will predict
frames that are not trained on. Other light that comes and goes in one place counts as well.
"""

from typing import Any

import numpy as np

from stages.scene.light_model import Light, cleared
from stages.scene.photometry import GREY_LEVELS, seen_change
from stages.scene.rules import Choice, light_decision, saves
from stages.scene.sightings import GROUP, Sightings
from stages.scene.weigh import NOTHING, Bought, weigh
from stages.shared.light import LIGHT_CHANGES

DENSITY = 4
"""Shadows fall on a small part of the scene: so many times as many points as for the light of the whole."""
HALVES = ((0, 3), (1, 2)), ((1, 2), (0, 3))
"""Of four neighbours, those that are predicted, and by which."""


def shadow_evidence(seen: Sightings, fitted: Light, degree: int = 0) -> Bought:
    """What changes over time save that neighbours show one training frame before and after, in grey levels.

    They count where both neighbours change by more than LIGHT_CHANGES, to the same side; elsewhere the light is steady.
    A highlight passes over a surface like a shadow. So what the view explains is taken out first, where it is modelled.

    Args:
        degree: of the harmonics by which colours depend on the view; 0 if they do not.
    """
    usable: np.ndarray = seen.usable.all(axis=2).reshape(-1, GROUP, seen.usable.shape[1])
    colours = np.where(usable[..., None], GREY_LEVELS * cleared(seen, fitted).reshape(*usable.shape, 3), np.nan)
    kept = np.flatnonzero(usable.any(axis=2).sum(axis=1) == GROUP)
    usable, colours = usable[kept], colours[kept]
    if not len(usable) or usable.shape[2] < 3:
        return NOTHING
    if degree:
        colours = colours - GREY_LEVELS * seen_change(seen, fitted, degree)[kept]
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


def decide_moving_shadows(bought: Bought, choice: Choice) -> dict[str, Any]:
    """The entry of scene.json: the same must be saved as by gains."""
    why = f"the change that neighbours show in the frames around {saves(bought, 'grey levels')}"
    return light_decision(bought, False, {}, why, choice)
