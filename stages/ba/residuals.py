"""Inner loops over single residuals (numba): their lengths, and the search for inverse depths with the poses fixed."""

import numpy as np
from numba import njit, prange

from stages.ba.kernel import FAST, MIN_DEPTH_RATIO, Geometry, Observations

BEHIND_PX = 1e6
"""The length of a residual whose point is behind the target camera."""


@njit(**FAST)
def _residual(data: Observations, at: Geometry, e: int, p: int, d: float) -> tuple[float, ...]:
    """Residual (a, b) of one pixel at inverse depth d, its derivative by d, and whether it is ahead."""
    focal, cx, cy = at.lens[0], at.lens[1], at.lens[2]
    R, t = at.R[e], at.t[e]
    x, y = (data.pixels[p, 0] - cx) / focal, (data.pixels[p, 1] - cy) / focal
    Z = R[2, 0] * x + R[2, 1] * y + R[2, 2] + d * t[2]
    ahead = Z > MIN_DEPTH_RATIO
    f_z = focal / Z if ahead else 0.0
    u = (R[0, 0] * x + R[0, 1] * y + R[0, 2] + d * t[0]) * f_z / focal
    v = (R[1, 0] * x + R[1, 1] * y + R[1, 2] + d * t[1]) * f_z / focal
    a, b = data.matches[e, p, 0] - (focal * u + cx), data.matches[e, p, 1] - (focal * v + cy)
    return a, b, f_z * (t[0] - u * t[2]), f_z * (t[1] - v * t[2]), 1.0 if ahead else 0.0


@njit(parallel=True, **FAST)
def errors_px(data: Observations, at: Geometry) -> np.ndarray:
    """Lengths of the residuals [E, P] float32 in px; BEHIND_PX where the point is behind the target camera."""
    E, P = data.weights.shape
    errors = np.empty((E, P), np.float32)
    for e in prange(E):
        i = data.source[e]
        for p in range(P):
            a, b, _, _, ahead = _residual(data, at, e, p, at.inverse_depth[i, p])
            errors[e, p] = np.sqrt(a * a + b * b) if ahead > 0.0 else BEHIND_PX
    return errors


@njit(**FAST)
def _depth_probe(data: Observations, at: Geometry, sigma: float, i: int, p: int, d: float) -> tuple[float, ...]:
    """Robust cost of one pixel at inverse depth d over its edges, and the Gauss-Newton terms for the next d."""
    cost, curvature, gradient = 0.0, 0.0, 0.0
    for e in range(data.pointer[i], data.pointer[i + 1]):
        a, b, D_a, D_b, ahead = _residual(data, at, e, p, d)
        error = (a * a + b * b) / (sigma * sigma)
        w = ahead * data.weights[e, p] / ((1.0 + error) * (1.0 + error))
        cost += data.weights[e, p] * (error / (1.0 + error) if ahead > 0.0 else 1.0)
        curvature += w * (D_a * D_a + D_b * D_b)
        gradient += w * (D_a * a + D_b * b)
    return cost, curvature, gradient


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
    K, T, P = candidates.shape
    best_depth, best_curvature = candidates[0].copy(), np.zeros((T, P))
    for i in prange(T):
        for p in range(P):
            best = np.inf
            for k in range(K):
                d = candidates[k, i, p]
                for _ in range(refinements + 1):
                    cost, curvature, gradient = _depth_probe(data, at, sigma, i, p, d)
                    if cost < best:
                        best, best_depth[i, p], best_curvature[i, p] = cost, d, curvature
                    d = min(max(d + gradient / (curvature + 1e-9), lowest), highest)
    return best_depth, best_curvature
