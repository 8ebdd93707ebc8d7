"""Normal equations of all edges, and the steps of the inverse depths, by the kernels of `stages.ba.kernel`."""

import numpy as np

from stages.ba.kernel import PINHOLE, EdgeMatches, Geometry, add_frames, explain
from stages.shared.threads import spread


def normal_equations(
    data: EdgeMatches,
    at: Geometry,
    sigma: float,
    damping: float,
    depth_prior: float,
    zoom: bool = False,
    lens: np.ndarray = PINHOLE,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Local normal equations of every edge, and the Schur complement term of eliminating the inverse depths.

    Args:
        sigma: scale of the robust kernel, px; damping: relative, of Levenberg-Marquardt.
        depth_prior: weight, px^2, of the prior that every inverse depth is 1.
        zoom: whether every frame has a focal length of its own.
        lens: (c1, c2, radius in px) of a lens, or PINHOLE.

    Returns:
        hessians [E, 8, 8] over (twist 6, log focal, residual), symmetric; schur [T, n, n] with n = 6 k + 2 rows
        (twists of the frame's k edges, log focal, gradient); curvature (damped, or that of a depth that is held) and
        gradient [T, P] of the depths.
        With zoom, hessians [E, 9, 9] over (twist 6, log focal of the target, of the source, residual) and n = 7 k + 2
        (twist and log focal of the target of every edge, log focal of the source, gradient). Behind a lens its two
        coefficients stand after the last log focal.
    """
    T, P = at.inverse_depth.shape
    rows = 7 if zoom else 6
    shared = 4 if len(lens) else 2
    size = rows * int(np.diff(data.pointer).max()) + shared
    hessians, schur = np.zeros((len(data.source), rows + shared, rows + shared)), np.zeros((T, size, size))
    curvatures, gradients = np.ones((T, P)), np.zeros((T, P))
    scales = np.array([sigma, damping, depth_prior])
    spread(add_frames, T, data, at, lens, scales, rows, hessians, schur, curvatures, gradients)
    hessians += np.triu(hessians, 1).swapaxes(1, 2)
    return hessians, schur, curvatures, gradients


def depth_steps(
    data: EdgeMatches,
    at: Geometry,
    sigma: float,
    curvatures: np.ndarray,
    gradients: np.ndarray,
    local_steps: np.ndarray,
    lens: np.ndarray = PINHOLE,
) -> np.ndarray:
    """Steps [T, P] of the inverse depths once the local steps of the edges are known: [E, 7] (twist, log focal), or
    [E, 8] (twist, log focal of target and source); two more, those of its coefficients, behind a lens."""
    explained = np.zeros(at.inverse_depth.shape)
    spread(explain, len(explained), data, at, lens, sigma, local_steps, explained)
    return np.asarray((gradients - explained) / curvatures)
