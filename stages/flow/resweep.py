"""Does any depth explain the flow of a pixel? The best fit over inverse depth with the cameras held fixed.

A static pixel p of frame i is seen in frame j at A p + d b (homogeneous), with A = K_j R_ij K_i^-1, b = K_j t_ij and
inverse depth d >= 0. A pixel whose flows to several frames fit no single d moves on its own. Depth is searched anew
and masks take no part: a depth solved under a mask, or a mask in the weights, would confirm itself.
"""

from collections.abc import Mapping

import cv2
import numba
import numpy as np

from stages.flow.epipolar import Evidence
from stages.shared import lie
from stages.shared.cameras import pixel_grid

D_MAX = 50.0
"""Largest inverse depth, in units of the scene's median."""
RIDGE_PX2 = 0.01
"""Parallax below a tenth of a pixel says nothing about depth: the start is kept."""
Z_MIN = 0.05
REFINEMENTS = 2
SIGMA_RANGE_PX = (0.5, 3.0)
COARSE = 8
"""Every eighth pixel is enough to measure the noise."""


def camera_evidence(
    pairs: Mapping[str, np.ndarray], cam_from_world: np.ndarray, Ks: np.ndarray, start: np.ndarray
) -> tuple[Evidence, np.ndarray, float]:
    """Misfit [T, h, w] to the best depth under the cameras, with its weight; that inverse depth; the noise scale in px.

    The scale is three times the median residual within 0.5..3 px: a fixed one lets masks run away on noisy flow.
    Edges weigh as much as their frames are apart: slow motion shows over many frames only.

    Args:
        pairs: source, target [E], flow [E, h, w, 2] px, weights [E, h, w].
        cam_from_world: [T, 4, 4]; Ks: [T, 3, 3] on the flow grid; start: [T, h, w] inverse depth.
    """
    unit = float(np.median(start))
    A, b = projections(pairs, cam_from_world, Ks)
    b = unit * b
    pointer = np.searchsorted(pairs["source"], np.arange(len(start) + 1))
    distance = np.abs(pairs["source"] - pairs["target"])
    weights = pairs["weights"] * (distance / distance.mean()).astype(np.float32)[:, None, None]
    inputs = (pairs["flow"], weights, (start / unit).astype(np.float32))
    _, inverse_depth = sweep(pointer, A, b, *inputs, 1.0, COARSE)
    sigma_px = float(np.clip(3 * _median_residual(A, b, pairs, inverse_depth), *SIGMA_RANGE_PX))
    misfit, inverse_depth = sweep(pointer, A, b, *inputs, sigma_px, 1)
    weight = np.add.reduceat(weights, pointer[:-1], axis=0)
    return Evidence(misfit, weight), unit * inverse_depth, sigma_px


def projections(
    pairs: Mapping[str, np.ndarray], cam_from_world: np.ndarray, Ks: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A [E, 3, 3] and b [E, 3] of every edge, as above."""
    i, j = pairs["source"], pairs["target"]
    relative = cam_from_world[j] @ lie.inverse(cam_from_world[i])
    return Ks[j] @ relative[:, :3, :3] @ np.linalg.inv(Ks[i]), (Ks[j] @ relative[:, :3, 3:])[..., 0]


def rigid_flow(A: np.ndarray, b: np.ndarray, inverse_depth: np.ndarray) -> np.ndarray:
    """Flow [h, w, 2] float32 px of a static world of inverse depth [h, w] along an edge with A [3, 3], b [3]."""
    pixels = pixel_grid(*inverse_depth.shape).astype(np.float32)
    there = pixels @ A[:, :2].T.astype(np.float32) + (A[:, 2] + inverse_depth[..., None] * b).astype(np.float32)
    return np.asarray(there[..., :2] / np.maximum(there[..., 2:], Z_MIN) - pixels)


def resample(inverse_depth: np.ndarray, cell_px: float, h: int, w: int) -> np.ndarray:
    """Inverse depth [T, rows, columns] of cells of `cell_px` flow pixels on the flow grid, [T, h, w] float32."""
    shift = 0.5 / cell_px - 0.5
    grid_from_flow = np.array([[1 / cell_px, 0, shift], [0, 1 / cell_px, shift]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    frames = [
        cv2.warpAffine(d, grid_from_flow, (w, h), flags=flags, borderMode=cv2.BORDER_REPLICATE) for d in inverse_depth
    ]
    return np.stack(frames).astype(np.float32)


def _median_residual(A: np.ndarray, b: np.ndarray, pairs: Mapping[str, np.ndarray], inverse_depth: np.ndarray) -> float:
    """Median residual in px of confident flow at the coarse inverse depths."""
    grid = slice((COARSE - 1) // 2, None, COARSE)
    pixels = pixel_grid(*pairs["weights"].shape[1:])[grid, grid]
    homogeneous = np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1)
    residuals = []
    for e, i in enumerate(pairs["source"]):
        there = homogeneous @ A[e].T + inverse_depth[i][..., None] * b[e]
        confident = (pairs["weights"][e, grid, grid] > 0.5) & (there[..., 2] > Z_MIN)
        offset = pixels + pairs["flow"][e, grid, grid] - there[..., :2] / there[..., 2:]
        residuals.append(np.linalg.norm(offset[confident], axis=-1))
    pooled = np.concatenate(residuals)
    return float(np.median(pooled)) if pooled.size else 0.0


def sweep(
    pointer: np.ndarray,
    A: np.ndarray,
    b: np.ndarray,
    flow: np.ndarray,
    weights: np.ndarray,
    start: np.ndarray,
    sigma_px: float,
    stride: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Best robust misfit per pixel over inverse depth, and that inverse depth.

    Candidates are the inverse depths that each edge alone would triangulate, and `start`; the best of them is refined
    by Gauss-Newton steps. The misfit is the weighted mean of the Geman-McClure cost r^2 / (r^2 + sigma^2) in 0..1.

    Args:
        pointer: [T + 1] int64, edges pointer[i]..pointer[i + 1] leave frame i.
        A: [E, 3, 3], b: [E, 3] float64 as above, b for inverse depths whose median is about 1.
        flow: [E, h, w, 2] px (float16 or float32), weights: [E, h, w] in 0..1.
        start: [T, h, w] float32 inverse depth.
        stride: every `stride`-th pixel from (stride - 1) // 2 is solved.

    Returns:
        misfit [T, rows, columns] float32 (0 where no weight), inverse depth of the same shape.
    """
    o = (stride - 1) // 2
    sampled = (np.ascontiguousarray(part[:, o::stride, o::stride], np.float32) for part in (flow, weights, start))
    return _sweep(pointer, A, b, *sampled, float(sigma_px), stride, o)


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _misfit(first, last, A, b, flow, weights, y, x, u, v, d, sigma2):  # type: ignore[no-untyped-def]
    """Cost at inverse depth d, and the Gauss-Newton step of d."""
    cost, curvature, gradient = 0.0, RIDGE_PX2, 0.0
    for e in range(first, last):
        w = weights[e, y, x]
        Z = A[e, 2, 0] * u + A[e, 2, 1] * v + A[e, 2, 2] + d * b[e, 2]
        if w <= 0.0:
            continue
        if Z < Z_MIN:
            cost += w
            continue
        pu = (A[e, 0, 0] * u + A[e, 0, 1] * v + A[e, 0, 2] + d * b[e, 0]) / Z
        pv = (A[e, 1, 0] * u + A[e, 1, 1] * v + A[e, 1, 2] + d * b[e, 1]) / Z
        ru, rv = u + flow[e, y, x, 0] - pu, v + flow[e, y, x, 1] - pv
        ju, jv = (b[e, 0] - pu * b[e, 2]) / Z, (b[e, 1] - pv * b[e, 2]) / Z
        q = (ru * ru + rv * rv) / sigma2
        cost += w * q / (1 + q)
        robust = w / ((1 + q) * (1 + q))
        curvature += robust * (ju * ju + jv * jv)
        gradient += robust * (ju * ru + jv * rv)
    return cost, gradient / curvature


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _triangulated(A, b, du, dv, u, v, start):  # type: ignore[no-untyped-def]
    """Inverse depth at which one edge's flow (du, dv) is met best, drawn to `start` where there is no parallax."""
    a0 = A[0, 0] * u + A[0, 1] * v + A[0, 2]
    a1 = A[1, 0] * u + A[1, 1] * v + A[1, 2]
    a2 = A[2, 0] * u + A[2, 1] * v + A[2, 2]
    su, sv = b[0] - (u + du) * b[2], b[1] - (v + dv) * b[2]
    ou, ov = (u + du) * a2 - a0, (v + dv) * a2 - a1
    d = (su * ou + sv * ov + RIDGE_PX2 * start) / (su * su + sv * sv + RIDGE_PX2)
    return min(max(d, 0.0), D_MAX)


@numba.njit(cache=True, parallel=True, fastmath=True, error_model="numpy")
def _sweep(pointer, A, b, flow, weights, start, sigma_px, stride, offset):  # type: ignore[no-untyped-def]
    T, rows, columns = start.shape
    misfit = np.zeros((T, rows, columns), np.float32)
    inverse_depth = start.copy()
    for row in numba.prange(T * rows):
        i, y = row // rows, row % rows
        first, last = pointer[i], pointer[i + 1]
        for x in range(columns):
            u, v = float(x * stride + offset), float(y * stride + offset)
            total = 0.0
            for e in range(first, last):
                total += weights[e, y, x]
            if total <= 0.0:
                continue
            best_d = float(start[i, y, x])
            best, step = _misfit(first, last, A, b, flow, weights, y, x, u, v, best_d, sigma_px**2)
            for e in range(first, last):
                if weights[e, y, x] > 0.0:
                    d = _triangulated(A[e], b[e], flow[e, y, x, 0], flow[e, y, x, 1], u, v, start[i, y, x])
                    cost, its_step = _misfit(first, last, A, b, flow, weights, y, x, u, v, d, sigma_px**2)
                    if cost < best:
                        best, step, best_d = cost, its_step, d
            for _ in range(REFINEMENTS):
                d = min(max(best_d + step, 0.0), D_MAX)
                cost, its_step = _misfit(first, last, A, b, flow, weights, y, x, u, v, d, sigma_px**2)
                if cost < best:
                    best, step, best_d = cost, its_step, d
            misfit[i, y, x] = best / total
            inverse_depth[i, y, x] = best_d
    return misfit, inverse_depth
