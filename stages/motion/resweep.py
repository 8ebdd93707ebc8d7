"""Residual of the flow at the best inverse depth of each pixel, with the cameras fixed.

A static pixel p of frame i is seen in frame j at A p + d b (homogeneous), with A = K_j R_ij K_i^-1, b = K_j t_ij and
inverse depth d >= 0. A pixel moves if its flows to several frames fit no single d. The depth is searched without
masks: a depth solved with a mask, or a mask in the weights, would confirm the mask.
"""

import itertools

import numba
import numpy as np

from stages.motion.epipolar import Evidence
from stages.shared.cameras import pixel_grid, projection, static_flow
from stages.shared.finite import require_finite
from stages.shared.flow_pairs import REACH, FlowPairs
from stages.shared.static_flow import Z_MIN
from stages.shared.threads import spread, threaded

D_MAX = 50.0
"""Largest inverse depth, in units of the scene's median."""
RIDGE_PX2 = 0.01
"""Parallax below a tenth of a pixel does not determine depth: the initial depth is kept."""
REFINEMENTS = 2
NOISE_SCALE = 5.0
SIGMA_RANGE_PX = (0.35, 3.0)
"""Bounds of the robust scale, a multiple of the median residual."""
COARSE = 8
"""Every eighth pixel is enough to measure the noise."""
FAST = {"cache": True, "nogil": True, "fastmath": {"nnan", "ninf", "nsz", "contract"}, "error_model": "numpy"}
"""Sums keep their order: a loop that the compiler reorders rounds otherwise where it falls back to single pixels, which
depends on where the arrays lie."""


def camera_evidence(
    pairs: FlowPairs, cam_from_world: np.ndarray, Ks: np.ndarray, start: np.ndarray
) -> tuple[Evidence, np.ndarray, float]:
    """Residual [T, h, w] at the best depth with its weight; that inverse depth; the robust scale in px.

    The scale follows the median residual: with a fixed one, masks grow without bound on noisy flow and slow motion is
    missed where flow is good.
    The weight of an edge is proportional to its frame distance: slow motion shows over many frames only. What
    has changed when a place is seen again is no evidence.

    Args:
        cam_from_world: [T, 4, 4]; Ks: [T, 3, 3] on the flow grid; start: [T, h, w] inverse depth.
    """
    require_finite(poses=cam_from_world, intrinsics=Ks, start=start)
    unit = float(np.median(start))
    A, b = projections(pairs, cam_from_world, Ks)
    b = unit * b
    distance = np.abs(pairs.source - pairs.target)
    distance = np.where(distance <= REACH, distance, 0)
    importance = (distance / distance[distance > 0].mean()).astype(np.float32)

    def solved(first: int, last: int, sigma_px: float, stride: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residual and inverse depth of a run of frames on every `stride`-th pixel, and their weights on all."""
        rows = pairs.leaving(first, last)
        edges = slice(rows.start, rows.stop)
        require_finite(flow=pairs.flow[edges], confidence=pairs.confidence[edges])
        pointer = np.searchsorted(pairs.source[edges], np.arange(first, last + 1))
        weights = np.zeros((len(rows), *start.shape[1:]), np.float32)
        for e, of_edge in zip(rows, threaded(pairs.weights, rows), strict=True):
            weights[e - rows.start] = importance[e] * of_edge
        near = (start[first:last] / unit).astype(np.float32)
        found = sweep(pointer, A[edges], b[edges], pairs.flow[edges], weights, near, sigma_px, stride)
        return *found, np.stack([weights[begin:end].sum(axis=0) for begin, end in itertools.pairwise(pointer)])

    T = len(start)
    coarse = np.concatenate([solved(*block, 1.0, COARSE)[1] for block in pairs.blocks(T, "coarse depth")])
    sigma_px = float(np.clip(NOISE_SCALE * _median_residual(A, b, pairs, coarse), *SIGMA_RANGE_PX))
    residual, inverse_depth, weight = (np.empty(start.shape, np.float32) for _ in range(3))
    for first, last in pairs.blocks(T, "static depth"):
        run = slice(first, last)
        residual[run], inverse_depth[run], weight[run] = solved(first, last, sigma_px, 1)
    inverse_depth *= np.float32(unit)
    return Evidence(residual, weight), inverse_depth, sigma_px


def projections(pairs: FlowPairs, cam_from_world: np.ndarray, Ks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A [E, 3, 3] and b [E, 3] of every edge, as above."""
    i, j = pairs.source, pairs.target
    return projection((cam_from_world[i], Ks[i]), (cam_from_world[j], Ks[j]))


def _median_residual(A: np.ndarray, b: np.ndarray, pairs: FlowPairs, inverse_depth: np.ndarray) -> float:
    """Median residual in px of confident flow at the coarse inverse depths."""
    grid = slice((COARSE - 1) // 2, None, COARSE)
    pixels = pixel_grid(*pairs.confidence.shape[1:])[grid, grid]
    residuals = []
    edges = (e for block in pairs.blocks(len(inverse_depth), "residuals") for e in pairs.leaving(*block))
    for e in edges:
        i = pairs.source[e]
        if abs(pairs.target[e] - i) > REACH:
            continue
        flow, ratio = static_flow(pixels, inverse_depth[i], A[e], b[e])
        confident = (pairs.weights(e)[grid, grid] > 0.5) & (ratio > Z_MIN)
        residuals.append(np.linalg.norm((pairs.flow[e, grid, grid] - flow)[confident], axis=-1))
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
    """Lowest robust residual per pixel over inverse depth, and that inverse depth.

    Candidates are the inverse depths that each edge alone would triangulate, and `start`; the best of them is refined
    by Gauss-Newton steps. The residual is the weighted mean of the Geman-McClure cost r^2 / (r^2 + sigma^2) in 0..1.

    Args:
        pointer: [T + 1] int64, edges pointer[i]..pointer[i + 1] leave frame i.
        A: [E, 3, 3], b: [E, 3] float64 as above, b for inverse depths whose median is about 1.
        flow: [E, h, w, 2] px (float16 or float32), weights: [E, h, w] in 0..1.
        start: [T, h, w] float32 inverse depth.
        stride: every `stride`-th pixel from (stride - 1) // 2 is solved.

    Returns:
        residual [T, rows, columns] float32 (0 where no weight), inverse depth of the same shape.
    """
    o = (stride - 1) // 2
    sampled = (np.ascontiguousarray(part[:, o::stride, o::stride], np.float32) for part in (flow, weights, start))
    # float32 holds a pixel to 1e-4 px, and twice as many fit a vector instruction.
    lines = A.astype(np.float32), b.astype(np.float32)
    flow, weights, start = sampled
    u = (np.arange(start.shape[2]) * stride + o).astype(np.float32)
    v = (np.arange(start.shape[1]) * stride + o).astype(np.float32)
    residual, inverse_depth = np.zeros_like(start), np.empty_like(start)
    rows = start.shape[0] * start.shape[1]
    spread(_sweep, rows, pointer, *lines, flow, weights, u, v, start, np.float32(sigma_px**2), residual, inverse_depth)
    return residual, inverse_depth


@numba.njit(**FAST)
def _sweep(begin, end, pointer, A, b, flow, weights, u, v, start, sigma2, residual, inverse_depth):  # type: ignore[no-untyped-def]
    rows = len(v)
    for row in range(begin, end):
        i, y = row // rows, row % rows
        edges = pointer[i], pointer[i + 1]
        _sweep_row(edges, y, A, b, flow, weights, u, v[y], start[i, y], sigma2, residual[i, y], inverse_depth[i, y])


@numba.njit(**FAST)
def _sweep_row(edges, y, A, b, flow, weights, u, v, start, sigma2, residual, inverse_depth):  # type: ignore[no-untyped-def]
    """Fill the lowest residual [n] and inverse depth [n] of row y, of pixels u [n], v.

    The innermost loop runs over adjacent pixels, so that it becomes vector instructions.
    """
    first, last = edges
    n = len(u)
    s, t = np.empty((last - first, n), np.float32), np.empty((last - first, n), np.float32)
    d, best, best_step = start.copy(), np.full(n, np.float32(1e30)), np.zeros(n, np.float32)
    cost, gradient, curvature = np.zeros(n, np.float32), np.zeros(n, np.float32), np.zeros(n, np.float32)
    for e in range(first, last):
        for x in range(n):
            s[e - first, x], t[e - first, x] = u[x] + flow[e, y, x, 0], v + flow[e, y, x, 1]
            residual[x] += weights[e, y, x]
    for trial in range(first - 1, last + REFINEMENTS):
        if first <= trial < last:
            _triangulate(A[trial], b[trial], s[trial - first], t[trial - first], u, v, start, d)
        elif trial >= last:
            for x in range(n):
                d[x] = min(max(inverse_depth[x] + best_step[x], np.float32(0)), np.float32(D_MAX))
        cost[:], gradient[:], curvature[:] = 0, 0, RIDGE_PX2
        for e in range(first, last):
            _add_edge(A[e], b[e], s[e - first], t[e - first], weights[e, y], u, v, d, sigma2, cost, gradient, curvature)
        for x in range(n):
            matched = trial < first or trial >= last or weights[trial, y, x] > 0
            if matched and cost[x] < best[x]:
                best[x], best_step[x], inverse_depth[x] = cost[x], gradient[x] / curvature[x], d[x]
    for x in range(n):
        residual[x] = best[x] / residual[x] if residual[x] > 0 else np.float32(0)


@numba.njit(**FAST)
def _add_edge(A, b, s, t, weights, u, v, d, sigma2, cost, gradient, curvature):  # type: ignore[no-untyped-def]
    """Add the cost of one edge with matches s [n], t [n] at inverse depths d [n], and its Gauss-Newton terms."""
    a0, a1, a2 = A[0, 0], A[1, 0], A[2, 0]
    c0, c1, c2 = A[0, 1] * v + A[0, 2], A[1, 1] * v + A[1, 2], A[2, 1] * v + A[2, 2]
    b0, b1, b2 = b[0], b[1], b[2]
    one, nearest = np.float32(1), np.float32(Z_MIN)
    for x in range(len(d)):
        Z = a2 * u[x] + c2 + d[x] * b2
        inverse = one / max(Z, nearest)
        pu, pv = (a0 * u[x] + c0 + d[x] * b0) * inverse, (a1 * u[x] + c1 + d[x] * b1) * inverse
        ru, rv = s[x] - pu, t[x] - pv
        ju, jv = (b0 - pu * b2) * inverse, (b1 - pv * b2) * inverse
        inlier = one / (one + (ru * ru + rv * rv) / sigma2) if nearest <= Z else np.float32(0)
        robust = weights[x] * inlier * inlier
        cost[x] += weights[x] * (one - inlier)
        curvature[x] += robust * (ju * ju + jv * jv)
        gradient[x] += robust * (ju * ru + jv * rv)


@numba.njit(**FAST)
def _triangulate(A, b, s, t, u, v, start, d):  # type: ignore[no-untyped-def]
    """Fill the inverse depths d [n] that fit the matches s [n], t [n] of one edge best; `start` without parallax."""
    a0, a1, a2 = A[0, 0], A[1, 0], A[2, 0]
    c0, c1, c2 = A[0, 1] * v + A[0, 2], A[1, 1] * v + A[1, 2], A[2, 1] * v + A[2, 2]
    b0, b1, b2 = b[0], b[1], b[2]
    ridge, zero, most = np.float32(RIDGE_PX2), np.float32(0), np.float32(D_MAX)
    for x in range(len(d)):
        z = a2 * u[x] + c2
        du, dv = b0 - s[x] * b2, b1 - t[x] * b2
        ou, ov = s[x] * z - (a0 * u[x] + c0), t[x] * z - (a1 * u[x] + c1)
        met = (du * ou + dv * ov + ridge * start[x]) / (du * du + dv * dv + ridge)
        d[x] = min(max(met, zero), most)
