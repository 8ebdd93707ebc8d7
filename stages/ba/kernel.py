"""Inner loops of dense bundle adjustment (numba, float64): residuals, normal equations, depth elimination.

The residual of pixel p of source frame i in edge e = (i, j) is r = p* - Pi(R x + d t), where (R, t) = C_j C_i^-1,
x is the ray of p with z = 1, d its inverse depth and p* = p + flow. The scaled point R x + d t needs no division by
d, so points at infinity (d = 0) are ordinary. Local unknowns of an edge are the left twist of the target camera
[rho, omega] and log focal; if every frame has its own focal length, the log focals of target and source instead of the
one. `stages.ba.reduced` maps them to the unknowns of all frames. Robust weights are Geman-McClure.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from stages.shared.threads import spread

BLOCK = 256
"""Pixels per block: the Jacobian of a block stays in the L2 cache."""
MIN_DEPTH_RATIO = 0.1
"""A point nearer to the target camera than this share of its source depth counts as behind it."""
FAST = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}


class EdgeMatches(NamedTuple):
    """The observations: edges pointer[i]..pointer[i + 1] leave frame i; see `stages.ba.graph.FlowGraph`."""

    pointer: np.ndarray
    source: np.ndarray
    target: np.ndarray
    pixels: np.ndarray
    matches: np.ndarray
    weights: np.ndarray


class Geometry(NamedTuple):
    """Linearisation point: target_from_source R [E, 3, 3], t [E, 3]; inverse depth [T, P].

    Focal lengths [T] and principal point [2] in px.
    """

    R: np.ndarray
    t: np.ndarray
    inverse_depth: np.ndarray
    focals: np.ndarray
    centre: np.ndarray


@njit(**FAST)
def _linearise(
    data: EdgeMatches, at: Geometry, sigma: float, i: int, e: int, first: int, J: np.ndarray, D: np.ndarray
) -> None:
    """Fill J [8, 2 BLOCK] (twist, log focal, residual) and D [2 BLOCK] (inverse depth) for pixels from `first` on.

    With 9 rows J holds (twist, log focal of the target, log focal of the source, residual). Rows are scaled by the root
    of the weight; the u components come first, then the v components.
    """
    here, focal, cx, cy = at.focals[i], at.focals[data.target[e]], at.centre[0], at.centre[1]
    R, t = at.R[e], at.t[e]
    for q in range(min(BLOCK, data.pixels.shape[0] - first)):
        p, q2 = first + q, BLOCK + q
        x, y, d = (data.pixels[p, 0] - cx) / here, (data.pixels[p, 1] - cy) / here, at.inverse_depth[i, p]
        turned_x, turned_y, turned_z = R[0, 0] * x + R[0, 1] * y, R[1, 0] * x + R[1, 1] * y, R[2, 0] * x + R[2, 1] * y
        Z = turned_z + R[2, 2] + d * t[2]
        ahead = Z > MIN_DEPTH_RATIO
        f_z = focal / Z if ahead else 0.0
        u, v = (turned_x + R[0, 2] + d * t[0]) * f_z / focal, (turned_y + R[1, 2] + d * t[1]) * f_z / focal
        a, b = data.matches[e, p, 0] - (focal * u + cx), data.matches[e, p, 1] - (focal * v + cy)
        s = np.sqrt(np.float64(data.weights[e, p])) / (1.0 + (a * a + b * b) / (sigma * sigma)) if ahead else 0.0
        s_f, s_fz = s * focal, s * f_z
        J[0, q], J[0, q2] = s_fz * d, 0.0
        J[1, q], J[1, q2] = 0.0, s_fz * d
        J[2, q], J[2, q2] = -u * s_fz * d, -v * s_fz * d
        J[3, q], J[3, q2] = -s_f * u * v, -s_f * (1.0 + v * v)
        J[4, q], J[4, q2] = s_f * (1.0 + u * u), s_f * u * v
        J[5, q], J[5, q2] = -s_f * v, s_f * u
        J[6, q], J[6, q2] = s_f * u - s_fz * (turned_x - u * turned_z), s_f * v - s_fz * (turned_y - v * turned_z)
        J[7, q], J[7, q2] = s * a, s * b
        D[q], D[q2] = s_fz * (t[0] - u * t[2]), s_fz * (t[1] - v * t[2])
    if len(J) == 9:
        for q in range(2 * BLOCK):
            # The focal length of the target scales (u, v), the direction in which a roll turns, (-v, u), a quarter on.
            target = J[5, q + BLOCK] if q < BLOCK else -J[5, q - BLOCK]
            J[8, q], J[7, q], J[6, q] = J[7, q], J[6, q] - target, target


@njit(**FAST)
def _add_gram(J: np.ndarray, H: np.ndarray) -> None:
    """Add J J^T to the upper triangle of H [n, n], n the rows of J."""
    for a in range(len(J)):
        for b in range(a, len(J)):
            total = 0.0
            for q in range(2 * BLOCK):
                total += J[a, q] * J[b, q]
            H[a, b] += total


@njit(**FAST)
def _add_coupling(J: np.ndarray, D: np.ndarray, edge: int, coupling: np.ndarray, curvature: np.ndarray) -> None:
    """Fill the coupling of the rows of an edge, log focal and gradient with the inverse depths; add curvature."""
    last, rows = coupling.shape[0] - 2, len(J) - 2
    for q in range(BLOCK):
        q2 = BLOCK + q
        for a in range(rows):
            coupling[rows * edge + a, q] = J[a, q] * D[q] + J[a, q2] * D[q2]
        coupling[last, q] += J[rows, q] * D[q] + J[rows, q2] * D[q2]
        coupling[last + 1, q] += J[rows + 1, q] * D[q] + J[rows + 1, q2] * D[q2]
        curvature[q] += D[q] * D[q] + D[q2] * D[q2]


@njit(**FAST)
def _eliminate(coupling: np.ndarray, curvature: np.ndarray, scaled: np.ndarray, schur: np.ndarray) -> None:
    """Add coupling diag(1 / curvature) coupling^T [n, n] to `schur`; `scaled` is scratch of the shape of coupling."""
    n = coupling.shape[0]
    for a in range(n):
        for q in range(BLOCK):
            scaled[a, q] = coupling[a, q] / curvature[q]
    product = np.dot(scaled, coupling.T)
    for a in range(n):
        for b in range(n):
            schur[a, b] += product[a, b]


@njit(**FAST)
def _add_frames(
    begin: int,
    end: int,
    data: EdgeMatches,
    at: Geometry,
    scales: np.ndarray,
    hessians: np.ndarray,
    schur: np.ndarray,
    curvatures: np.ndarray,
    gradients: np.ndarray,
) -> None:
    """`normal_equations` of the source frames begin..end; scales are (sigma, damping, depth prior)."""
    sigma, damping, depth_prior = scales[0], scales[1], scales[2]
    P, size = len(data.pixels), hessians.shape[1]
    J, D, curvature = np.zeros((size, 2 * BLOCK)), np.zeros(2 * BLOCK), np.zeros(BLOCK)
    for i in range(begin, end):
        k = data.pointer[i + 1] - data.pointer[i]
        n = (size - 2) * k + 2
        coupling, scaled = np.zeros((n, BLOCK)), np.zeros((n, BLOCK))
        for first in range(0, P, BLOCK):
            count = min(BLOCK, P - first)
            if count < BLOCK:
                J[:], D[:], coupling[:] = 0.0, 0.0, 0.0
            coupling[n - 2 :] = 0.0
            curvature[:] = depth_prior
            for edge in range(k):
                _linearise(data, at, sigma, i, data.pointer[i] + edge, first, J, D)
                _add_gram(J, hessians[data.pointer[i] + edge])
                _add_coupling(J, D, edge, coupling, curvature)
            for q in range(count):
                coupling[n - 1, q] += depth_prior * (1.0 - at.inverse_depth[i, first + q])
                gradients[i, first + q] = coupling[n - 1, q]
                curvature[q] *= 1.0 + damping
                curvatures[i, first + q] = curvature[q]
            _eliminate(coupling, curvature, scaled, schur[i])


def normal_equations(
    data: EdgeMatches, at: Geometry, sigma: float, damping: float, depth_prior: float, zoom: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Local normal equations of every edge, and the Schur complement term of eliminating the inverse depths.

    Args:
        sigma: scale of the robust kernel, px; damping: relative, of Levenberg-Marquardt.
        depth_prior: weight, px^2, of the prior that every inverse depth is 1.
        zoom: whether every frame has a focal length of its own.

    Returns:
        hessians [E, 8, 8] over (twist 6, log focal, residual), symmetric; schur [T, n, n] with n = 6 k + 2 rows
        (twists of the frame's k edges, log focal, gradient); curvature (damped) and gradient [T, P] of the depths.
        With zoom, hessians [E, 9, 9] over (twist 6, log focal of the target, of the source, residual) and n = 7 k + 2
        (twist and log focal of the target of every edge, log focal of the source, gradient).
    """
    T, P = at.inverse_depth.shape
    rows = 7 if zoom else 6
    size = rows * int(np.diff(data.pointer).max()) + 2
    hessians, schur = np.zeros((len(data.source), rows + 2, rows + 2)), np.zeros((T, size, size))
    curvatures, gradients = np.ones((T, P)), np.zeros((T, P))
    scales = np.array([sigma, damping, depth_prior])
    spread(_add_frames, T, data, at, scales, hessians, schur, curvatures, gradients)
    hessians += np.triu(hessians, 1).swapaxes(1, 2)
    return hessians, schur, curvatures, gradients


@njit(**FAST)
def _explain(
    begin: int, end: int, data: EdgeMatches, at: Geometry, sigma: float, step: np.ndarray, out: np.ndarray
) -> None:
    """Add to `out` [T, P] the part of the depth gradients of frames begin..end due to the local steps [E, n]."""
    P, n = len(data.pixels), step.shape[1]
    J, D = np.zeros((n + 1, 2 * BLOCK)), np.zeros(2 * BLOCK)
    for i in range(begin, end):
        for e in range(data.pointer[i], data.pointer[i + 1]):
            for first in range(0, P, BLOCK):
                _linearise(data, at, sigma, i, e, first, J, D)
                for a in range(n):
                    for q in range(min(BLOCK, P - first)):
                        out[i, first + q] += step[e, a] * (J[a, q] * D[q] + J[a, BLOCK + q] * D[BLOCK + q])


def depth_steps(
    data: EdgeMatches,
    at: Geometry,
    sigma: float,
    curvatures: np.ndarray,
    gradients: np.ndarray,
    local_steps: np.ndarray,
) -> np.ndarray:
    """Steps [T, P] of the inverse depths once the local steps of the edges are known: [E, 7] (twist, log focal), or
    [E, 8] (twist, log focal of target and source)."""
    explained = np.zeros(at.inverse_depth.shape)
    spread(_explain, len(explained), data, at, sigma, local_steps, explained)
    return np.asarray((gradients - explained) / curvatures)
