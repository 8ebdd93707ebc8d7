"""Skinning of points by the control points, and its inverse: the canonical position of a point at some time."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from stages.deformation.lbs import blend, inverse_blend, lbs_weights, neighbours
from stages.deformation.motion_models import Deformation

MAX_ERROR = 0.5
"""Largest error of an accepted inverse after skinning it forward again, in median kernel radii."""


def skin(means: Tensor, time: float, deformation: Deformation, K: int) -> Tensor:
    """Positions [n, 3] at `time` 0..1 of canonical means [n, 3], moved by the K nearest control points."""
    return skinned(means, deformation, K)(time)


def skinned(means: Tensor, deformation: Deformation, K: int) -> Callable[[float], Tensor]:
    """`skin` as a function of the time alone: the control points that move a mean are those at all times."""
    index, sq_dist = neighbours(deformation.points, means, K)
    weights = lbs_weights(sq_dist, deformation.log_radii, index)
    unturned = means.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(means), 1)

    def at(time: float) -> Tensor:
        quats, translations = (motion[0] for motion in deformation(means.new_tensor([time])))
        return blend(means, unturned, deformation.points, quats, translations, weights, index)[0]

    return at


def to_canonical(
    positions: np.ndarray, times: np.ndarray, deformation: Deformation, K: int
) -> tuple[np.ndarray, np.ndarray]:
    """Canonical positions [n, 3] that skinning maps to `positions` [n, 3] at `times` [n], and which were found [n].

    Args:
        K: control points per Gaussian.
    """
    canonical, found = np.zeros_like(positions), np.zeros(len(positions), bool)
    points, log_radii = deformation.points, deformation.log_radii
    for time in np.unique(times):
        rows = times == time
        seen = torch.as_tensor(positions[rows], dtype=torch.float32)
        with torch.no_grad():
            quats, translations = (motion[0] for motion in deformation(seen.new_tensor([time])))
            rest, _ = inverse_blend(seen, points, quats, translations, log_radii, K)
            error = (seen - skin(rest, float(time), deformation, K)).norm(dim=-1)
            canonical[rows] = rest.numpy()
            found[rows] = (error < MAX_ERROR * log_radii.exp().median()).numpy()
    return canonical, found
