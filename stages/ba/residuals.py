"""Inner loops over single residuals (numba): their lengths, and the search for inverse depths with the poses fixed."""

import numpy as np
from numba import njit, prange

from stages.ba.kernel import BLOCK, FAST, MIN_DEPTH_RATIO, Geometry, Observations

BEHIND_PX = 1e6
"""The length of a residual whose point is behind the target camera."""


@njit(parallel=True, **FAST)
def errors_px(data: Observations, at: Geometry) -> np.ndarray:
    """Lengths of the residuals [E, P] float32 in px; BEHIND_PX where the point is behind the target camera."""
    E, P = data.weights.shape
    errors = np.empty((E, P), np.float32)
    for e in prange(E):
        _edge_errors_px(data, at, e, errors[e])
    return errors


@njit(**FAST)
def _edge_errors_px(data: Observations, at: Geometry, e: int, errors: np.ndarray) -> None:
    focal, cx, cy = at.lens[0], at.lens[1], at.lens[2]
    R, t, i, n = at.R[e], at.t[e], data.source[e], len(errors)
    r00, r01, r02, r10, r11, r12 = R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22, t0, t1, t2 = R[2, 0], R[2, 1], R[2, 2], t[0], t[1], t[2]
    x, y, match_u, match_v = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for p in range(n):  # sorted by component, so that the loop below becomes vector instructions
        x[p], y[p] = (data.pixels[p, 0] - cx) / focal, (data.pixels[p, 1] - cy) / focal
        match_u[p], match_v[p] = data.matches[e, p, 0] - cx, data.matches[e, p, 1] - cy
    for p in range(n):
        d = at.inverse_depth[i, p]
        Z = r20 * x[p] + r21 * y[p] + r22 + d * t2
        f_z = focal / max(Z, MIN_DEPTH_RATIO)
        a = match_u[p] - (r00 * x[p] + r01 * y[p] + r02 + d * t0) * f_z
        b = match_v[p] - (r10 * x[p] + r11 * y[p] + r12 + d * t1) * f_z
        errors[p] = np.sqrt(a * a + b * b) if Z > MIN_DEPTH_RATIO else BEHIND_PX


@njit(parallel=True, **FAST)
def sweep_depth(
    data: Observations,
    at: Geometry,
    sigma: float,
    candidates: np.ndarray,
    refinements: int,
    lowest: float,
    highest: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Best inverse depth per pixel with the poses fixed: candidates, each refined by Gauss-Newton steps.

    Args:
        candidates: [K, T, P] inverse depths to start from; lowest, highest: limits of the inverse depth.

    Returns:
        inverse depth [T, P] and its curvature [T, P] in px^2 per unit of inverse depth squared (0: unobserved).
    """
    _, T, P = candidates.shape
    best_depth, best_curvature = candidates[0].copy(), np.zeros((T, P))
    for i in prange(T):
        for first in range(0, P, BLOCK):
            pixels = first, min(first + BLOCK, P)
            limits = refinements, lowest, highest
            _sweep_block(data, at, sigma, i, pixels, candidates, limits, best_depth[i], best_curvature[i])
    return best_depth, best_curvature


@njit(**FAST)
def _sweep_block(
    data: Observations,
    at: Geometry,
    sigma: float,
    i: int,
    pixels: tuple[int, int],
    candidates: np.ndarray,
    limits: tuple[int, float, float],
    best_depth: np.ndarray,
    best_curvature: np.ndarray,
) -> None:
    """`sweep_depth` of some pixels of frame i; matches are sorted by component, so that loops over pixels vectorise."""
    first, n = pixels[0], pixels[1] - pixels[0]
    edges = data.pointer[i], data.pointer[i + 1]
    focal, cx, cy = at.lens[0], at.lens[1], at.lens[2]
    x, y = (data.pixels[first : first + n, 0] - cx) / focal, (data.pixels[first : first + n, 1] - cy) / focal
    s, t = np.empty((edges[1] - edges[0], n)), np.empty((edges[1] - edges[0], n))
    for e in range(edges[0], edges[1]):
        for q in range(n):
            s[e - edges[0], q] = data.matches[e, first + q, 0] - cx
            t[e - edges[0], q] = data.matches[e, first + q, 1] - cy
    d, best = np.empty(n), np.full(n, 1e300)
    cost, curvature, gradient = np.empty(n), np.empty(n), np.empty(n)
    for k in range(len(candidates)):
        d[:] = candidates[k, i, first : first + n]
        for _ in range(limits[0] + 1):
            cost[:], curvature[:], gradient[:] = 0.0, 0.0, 0.0
            for e in range(edges[0], edges[1]):
                seen = s[e - edges[0]], t[e - edges[0]], data.weights[e, first : first + n]
                _add_probe(at.R[e], at.t[e], focal, x, y, seen, d, sigma, cost, curvature, gradient)
            for q in range(n):
                if cost[q] < best[q]:
                    best[q], best_depth[first + q], best_curvature[first + q] = cost[q], d[q], curvature[q]
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
    """Add an edge's robust cost of rays x, y [n] at inverse depths d [n], and its Gauss-Newton terms for the next d."""
    match_u, match_v, weights = seen
    r00, r01, r02, r10, r11, r12 = R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22, t0, t1, t2 = R[2, 0], R[2, 1], R[2, 2], t[0], t[1], t[2]
    for q in range(len(d)):
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
