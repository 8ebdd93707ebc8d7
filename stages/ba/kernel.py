"""Inner loops of dense bundle adjustment (numba, float64): residuals, normal equations, depth elimination.

The residual of pixel p of source frame i in edge e = (i, j) is r = p* - Pi(R x + d t), where (R, t) = C_j C_i^-1,
x is the ray of p with z = 1, d its inverse depth and p* = p + flow. The scaled point R x + d t needs no division by
d, so points at infinity (d = 0) are ordinary. Local unknowns of an edge are the left twist of the target camera
[rho, omega] and log focal; if every frame has its own focal length, the log focals of target and source instead of the
one. `stages.ba.reduced` maps them to the unknowns of all frames. Robust weights are Geman-McClure.

A lens with radial distortion maps the projection q, px about the centre, to q (1 + c1 s + c2 s^2) with
s = |q|^2 / radius^2. Its matches are those of the distorted image, its `pixels` are undistorted, its coefficients c1
and c2 are unknowns that all edges share.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

PINHOLE = np.zeros(0)
"""In place of (c1, c2, radius in px) of a lens."""
BLOCK = 256
"""Pixels per block: the Jacobian of a block stays in the L2 cache."""
MIN_DEPTH_RATIO = 0.1
"""A point nearer to the target camera than this share of its source depth counts as behind it."""
HELD = 1e30
"""The curvature of an inverse depth that a step holds: finite, since FAST excludes infinity."""
FAST = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}


class EdgeMatches(NamedTuple):
    """The observations: edges pointer[i]..pointer[i + 1] leave frame i; see `stages.ba.graph.FlowGraph`.

    Attributes:
        held_below: the inverse depth below which a step holds one that is drawn farther down.
    """

    pointer: np.ndarray
    source: np.ndarray
    target: np.ndarray
    pixels: np.ndarray
    matches: np.ndarray
    weights: np.ndarray
    held_below: float


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
def _linearise_lens(
    data: EdgeMatches,
    at: Geometry,
    lens: np.ndarray,
    sigma: float,
    i: int,
    e: int,
    first: int,
    J: np.ndarray,
    D: np.ndarray,
) -> None:
    """As `_linearise` behind a lens: J, of 10 or 11 rows, has two for c1 and c2 before that of the residual."""
    here, focal, last, unit = at.focals[i], at.focals[data.target[e]], len(J) - 1, 1.0 / lens[2] ** 2
    R, t = at.R[e], at.t[e]
    for q in range(min(BLOCK, data.pixels.shape[0] - first)):
        p, q2 = first + q, BLOCK + q
        d = at.inverse_depth[i, p]
        px, py = data.pixels[p, 0] - at.centre[0], data.pixels[p, 1] - at.centre[1]
        x, y, s_p = px / here, py / here, (px * px + py * py) * unit
        turned_x, turned_y, turned_z = R[0, 0] * x + R[0, 1] * y, R[1, 0] * x + R[1, 1] * y, R[2, 0] * x + R[2, 1] * y
        Z = turned_z + R[2, 2] + d * t[2]
        ahead = Z > MIN_DEPTH_RATIO
        f_z = focal / Z if ahead else 0.0
        u, v = (turned_x + R[0, 2] + d * t[0]) * f_z / focal, (turned_y + R[1, 2] + d * t[1]) * f_z / focal
        qu, qv = focal * u, focal * v
        s_q = (qu * qu + qv * qv) * unit
        scale, bend = 1.0 + s_q * (lens[0] + s_q * lens[1]), (2.0 * lens[0] + 4.0 * s_q * lens[1]) * unit
        a, b = data.matches[e, p, 0] - at.centre[0] - scale * qu, data.matches[e, p, 1] - at.centre[1] - scale * qv
        s = np.sqrt(np.float64(data.weights[e, p])) / (1.0 + (a * a + b * b) / (sigma * sigma)) if ahead else 0.0
        J[0, q], J[0, q2] = f_z * d, 0.0
        J[1, q], J[1, q2] = 0.0, f_z * d
        J[2, q], J[2, q2] = -u * f_z * d, -v * f_z * d
        J[3, q], J[3, q2] = -qu * v, -focal - qv * v
        J[4, q], J[4, q2] = focal + qu * u, qu * v
        J[5, q], J[5, q2] = -qv, qu
        D[q], D[q2] = f_z * (t[0] - u * t[2]), f_z * (t[1] - v * t[2])
        by_ray_u, by_ray_v = f_z * (turned_x - u * turned_z), f_z * (turned_y - v * turned_z)
        J[6, q], J[6, q2] = qu, qv
        if last == 10:
            J[7, q], J[7, q2] = -by_ray_u, -by_ray_v
        else:
            J[6, q], J[6, q2] = qu - by_ray_u, qv - by_ray_v
        # With the match fixed, c1 moves the undistorted pixel along its radius, and then the projection.
        inward = s_p / (1.0 + s_p * (3.0 * lens[0] + 5.0 * s_p * lens[1]))
        J[last - 2, q], J[last - 2, q2] = -inward * by_ray_u, -inward * by_ray_v
        J[last - 1, q], J[last - 1, q2] = -inward * s_p * by_ray_u, -inward * s_p * by_ray_v
        for row in range(last):
            along = bend * (qu * J[row, q] + qv * J[row, q2])
            J[row, q], J[row, q2] = s * (scale * J[row, q] + along * qu), s * (scale * J[row, q2] + along * qv)
        along = bend * (qu * D[q] + qv * D[q2])
        D[q], D[q2] = s * (scale * D[q] + along * qu), s * (scale * D[q2] + along * qv)
        J[last - 2, q] += s * s_q * qu
        J[last - 2, q2] += s * s_q * qv
        J[last - 1, q] += s * s_q * s_q * qu
        J[last - 1, q2] += s * s_q * s_q * qv
        J[last, q], J[last, q2] = s * a, s * b


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
def _add_coupling(
    J: np.ndarray, D: np.ndarray, edge: int, rows: int, coupling: np.ndarray, curvature: np.ndarray
) -> None:
    """Fill the coupling of an edge, its `rows`, what is shared and the gradient, with the depths; add curvature."""
    shared = coupling.shape[0] - (len(J) - rows)
    for q in range(BLOCK):
        q2 = BLOCK + q
        for a in range(rows):
            coupling[rows * edge + a, q] = J[a, q] * D[q] + J[a, q2] * D[q2]
        for a in range(rows, len(J)):
            coupling[shared + a - rows, q] += J[a, q] * D[q] + J[a, q2] * D[q2]
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
def add_frames(
    begin: int,
    end: int,
    data: EdgeMatches,
    at: Geometry,
    lens: np.ndarray,
    scales: np.ndarray,
    rows: int,
    hessians: np.ndarray,
    schur: np.ndarray,
    curvatures: np.ndarray,
    gradients: np.ndarray,
) -> None:
    """Normal equations of frames begin..end; scales are (sigma, damping, depth prior), rows those of an edge."""
    sigma, damping, depth_prior = scales[0], scales[1], scales[2]
    P, size = len(data.pixels), hessians.shape[1]
    J, D, curvature = np.zeros((size, 2 * BLOCK)), np.zeros(2 * BLOCK), np.zeros(BLOCK)
    for i in range(begin, end):
        k = data.pointer[i + 1] - data.pointer[i]
        n = rows * k + size - rows
        coupling, scaled = np.zeros((n, BLOCK)), np.zeros((n, BLOCK))
        for first in range(0, P, BLOCK):
            count = min(BLOCK, P - first)
            if count < BLOCK:
                J[:], D[:], coupling[:] = 0.0, 0.0, 0.0
            coupling[rows * k :] = 0.0
            curvature[:] = depth_prior
            for edge in range(k):
                if len(lens):
                    _linearise_lens(data, at, lens, sigma, i, data.pointer[i] + edge, first, J, D)
                else:
                    _linearise(data, at, sigma, i, data.pointer[i] + edge, first, J, D)
                _add_gram(J, hessians[data.pointer[i] + edge])
                _add_coupling(J, D, edge, rows, coupling, curvature)
            for q in range(count):
                coupling[n - 1, q] += depth_prior * (1.0 - at.inverse_depth[i, first + q])
                gradients[i, first + q] = coupling[n - 1, q]
                held = at.inverse_depth[i, first + q] < data.held_below and coupling[n - 1, q] < 0.0
                curvature[q] = HELD if held else curvature[q] * (1.0 + damping)
                curvatures[i, first + q] = curvature[q]
            _eliminate(coupling, curvature, scaled, schur[i])


@njit(**FAST)
def explain(
    begin: int,
    end: int,
    data: EdgeMatches,
    at: Geometry,
    lens: np.ndarray,
    sigma: float,
    step: np.ndarray,
    out: np.ndarray,
) -> None:
    """Add to `out` [T, P] the part of the depth gradients of frames begin..end due to the local steps [E, n]."""
    P, n = len(data.pixels), step.shape[1]
    J, D = np.zeros((n + 1, 2 * BLOCK)), np.zeros(2 * BLOCK)
    for i in range(begin, end):
        for e in range(data.pointer[i], data.pointer[i + 1]):
            for first in range(0, P, BLOCK):
                if len(lens):
                    _linearise_lens(data, at, lens, sigma, i, e, first, J, D)
                else:
                    _linearise(data, at, sigma, i, e, first, J, D)
                for a in range(n):
                    for q in range(min(BLOCK, P - first)):
                        out[i, first + q] += step[e, a] * (J[a, q] * D[q] + J[a, BLOCK + q] * D[BLOCK + q])
