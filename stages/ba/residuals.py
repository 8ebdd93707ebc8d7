"""Inner loops over single residuals (numba): their lengths, and the search for inverse depths with the poses fixed."""

import numpy as np
from numba import njit

from stages.ba.kernel import BLOCK, FAST, MIN_DEPTH_RATIO, PINHOLE, EdgeMatches, Geometry
from stages.shared.threads import spread

BEHIND_PX = 1e6
"""The length of a residual whose point is behind the target camera."""


def errors_px(data: EdgeMatches, at: Geometry, lens: np.ndarray = PINHOLE) -> np.ndarray:
    """Lengths of the residuals [E, P] float32 in px; BEHIND_PX where the point is behind the target camera.

    Args:
        lens: (c1, c2, radius in px) of a lens, or PINHOLE; see `stages.ba.kernel`.
    """
    errors = np.empty(data.weights.shape, np.float32)
    if len(lens):
        spread(_errors_lens_px, len(errors), data, at, lens, errors)
    else:
        spread(_errors_px, len(errors), data, at, errors)
    return errors


@njit(**FAST)
def _errors_px(begin: int, end: int, data: EdgeMatches, at: Geometry, errors: np.ndarray) -> None:
    cx, cy = at.centre[0], at.centre[1]
    n = errors.shape[1]
    x, y, match_u, match_v = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for e in range(begin, end):
        R, t, i = at.R[e], at.t[e], data.source[e]
        here, focal = at.focals[i], at.focals[data.target[e]]
        r00, r01, r02, r10, r11, r12 = R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2]
        r20, r21, r22, t0, t1, t2 = R[2, 0], R[2, 1], R[2, 2], t[0], t[1], t[2]
        for p in range(n):  # one array per component, so that the loop below becomes vector instructions
            x[p], y[p] = (data.pixels[p, 0] - cx) / here, (data.pixels[p, 1] - cy) / here
            match_u[p], match_v[p] = data.matches[e, p, 0] - cx, data.matches[e, p, 1] - cy
        for p in range(n):
            d = at.inverse_depth[i, p]
            Z = r20 * x[p] + r21 * y[p] + r22 + d * t2
            f_z = focal / max(Z, MIN_DEPTH_RATIO)
            a = match_u[p] - (r00 * x[p] + r01 * y[p] + r02 + d * t0) * f_z
            b = match_v[p] - (r10 * x[p] + r11 * y[p] + r12 + d * t1) * f_z
            errors[e, p] = np.sqrt(a * a + b * b) if Z > MIN_DEPTH_RATIO else BEHIND_PX


@njit(**FAST)
def _errors_lens_px(
    begin: int, end: int, data: EdgeMatches, at: Geometry, lens: np.ndarray, errors: np.ndarray
) -> None:
    cx, cy, unit = at.centre[0], at.centre[1], 1.0 / lens[2] ** 2
    for e in range(begin, end):
        R, t, i = at.R[e], at.t[e], data.source[e]
        here, focal = at.focals[i], at.focals[data.target[e]]
        for p in range(errors.shape[1]):
            x, y, d = (data.pixels[p, 0] - cx) / here, (data.pixels[p, 1] - cy) / here, at.inverse_depth[i, p]
            Z = R[2, 0] * x + R[2, 1] * y + R[2, 2] + d * t[2]
            f_z = focal / max(Z, MIN_DEPTH_RATIO)
            u = (R[0, 0] * x + R[0, 1] * y + R[0, 2] + d * t[0]) * f_z
            v = (R[1, 0] * x + R[1, 1] * y + R[1, 2] + d * t[1]) * f_z
            s = (u * u + v * v) * unit
            scale = 1.0 + s * (lens[0] + s * lens[1])
            a, b = data.matches[e, p, 0] - cx - scale * u, data.matches[e, p, 1] - cy - scale * v
            errors[e, p] = np.sqrt(a * a + b * b) if Z > MIN_DEPTH_RATIO else BEHIND_PX


def sweep_depth(
    data: EdgeMatches,
    at: Geometry,
    sigma: float,
    candidates: np.ndarray,
    refinements: int,
    lowest: float,
    highest: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Best inverse depth per pixel with the poses fixed, among candidates that are each refined by Gauss-Newton steps.

    Args:
        candidates: [K, T, P] inverse depths to start from; lowest, highest: limits of the inverse depth.

    Returns:
        inverse depth [T, P] and its curvature [T, P] in px^2 per unit of inverse depth squared (0: unobserved).
    """
    _, T, P = candidates.shape
    best_depth, best_curvature = candidates[0].copy(), np.zeros((T, P))
    limits = refinements, lowest, highest
    spread(_sweep_depth, T, data, at, sigma, candidates, limits, best_depth, best_curvature)
    return best_depth, best_curvature


@njit(**FAST)
def _sweep_depth(
    begin: int,
    end: int,
    data: EdgeMatches,
    at: Geometry,
    sigma: float,
    candidates: np.ndarray,
    limits: tuple[int, float, float],
    best_depth: np.ndarray,
    best_curvature: np.ndarray,
) -> None:
    """`sweep_depth` of frames begin..end; one array per component of the matches, so that pixel loops vectorise."""
    P, cx, cy = candidates.shape[2], at.centre[0], at.centre[1]
    x, y, d, best = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    cost, curvature, gradient = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    for i in range(begin, end):
        e0, e1, focal = data.pointer[i], data.pointer[i + 1], at.focals[i]
        s, t = np.empty((e1 - e0, BLOCK)), np.empty((e1 - e0, BLOCK))
        for first in range(0, P, BLOCK):
            n = min(BLOCK, P - first)
            for q in range(n):
                x[q], y[q] = (data.pixels[first + q, 0] - cx) / focal, (data.pixels[first + q, 1] - cy) / focal
                best[q] = 1e300
            for e in range(e0, e1):
                for q in range(n):
                    s[e - e0, q], t[e - e0, q] = data.matches[e, first + q, 0] - cx, data.matches[e, first + q, 1] - cy
            for k in range(len(candidates)):
                for q in range(n):
                    d[q] = candidates[k, i, first + q]
                for _ in range(limits[0] + 1):
                    cost[:], curvature[:], gradient[:] = 0.0, 0.0, 0.0
                    for e in range(e0, e1):
                        seen = s[e - e0], t[e - e0], data.weights[e, first : first + n]
                        there = at.focals[data.target[e]]
                        _add_probe(at.R[e], at.t[e], there, x, y, seen, d, sigma, cost, curvature, gradient)
                    for q in range(n):
                        if cost[q] < best[q]:
                            best[q], best_depth[i, first + q], best_curvature[i, first + q] = (
                                cost[q],
                                d[q],
                                curvature[q],
                            )
                        d[q] = min(max(d[q] + gradient[q] / (curvature[q] + 1e-9), limits[1]), limits[2])


@njit(**FAST)
def _add_probe(
    R: np.ndarray,
    t: np.ndarray,
    focal: float,
    x: np.ndarray,
    y: np.ndarray,
    seen: tuple[np.ndarray, np.ndarray, np.ndarray],
    d: np.ndarray,
    sigma: float,
    cost: np.ndarray,
    curvature: np.ndarray,
    gradient: np.ndarray,
) -> None:
    """Add an edge's robust cost of rays x, y [n] at inverse depths d [n], and the Gauss-Newton terms in d."""
    match_u, match_v, weights = seen
    r00, r01, r02, r10, r11, r12 = R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22, t0, t1, t2 = R[2, 0], R[2, 1], R[2, 2], t[0], t[1], t[2]
    for q in range(len(weights)):
        Z = r20 * x[q] + r21 * y[q] + r22 + d[q] * t2
        inverse = 1.0 / max(Z, MIN_DEPTH_RATIO)
        u = (r00 * x[q] + r01 * y[q] + r02 + d[q] * t0) * inverse
        v = (r10 * x[q] + r11 * y[q] + r12 + d[q] * t1) * inverse
        a, b = match_u[q] - focal * u, match_v[q] - focal * v
        D_a, D_b = focal * inverse * (t0 - u * t2), focal * inverse * (t1 - v * t2)
        inlier = 1.0 / (1.0 + (a * a + b * b) / (sigma * sigma)) if Z > MIN_DEPTH_RATIO else 0.0
        w = weights[q] * inlier * inlier
        cost[q] += weights[q] * (1.0 - inlier)
        curvature[q] += w * (D_a * D_a + D_b * D_b)
        gradient[q] += w * (D_a * a + D_b * b)
