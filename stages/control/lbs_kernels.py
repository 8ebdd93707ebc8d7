"""Numba kernels of linear blend skinning: weights, the blend of K rigid motions per Gaussian, and their adjoints.

Quaternions travel as tuples: arrays made inside the loops would live on the heap and cost more than the arithmetic.
"""

import numpy as np
from numba import njit, prange

CHUNKS = 16
"""Partial sums of the scatter into control points: a fixed number, so results do not depend on the thread count."""
FAST = {"cache": True, "fastmath": {"contract", "nsz", "arcp"}, "error_model": "numpy"}
"""Fused multiply-add and reciprocals; not the flags that assume away infinities and NaN."""
Quaternion = tuple[float, float, float, float]


@njit(inline="always", **FAST)
def _product(a: Quaternion, b: Quaternion) -> Quaternion:
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@njit(inline="always", **FAST)
def _row(quats: np.ndarray, n: int) -> Quaternion:
    return quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3]


@njit(inline="always", **FAST)
def _dot(a: Quaternion, b: Quaternion) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]


@njit(inline="always", **FAST)
def _conjugate(q: Quaternion) -> Quaternion:
    return q[0], -q[1], -q[2], -q[3]


@njit(inline="always", **FAST)
def _unit(q: Quaternion) -> tuple[Quaternion, float]:
    """q / |q| and |q|, through the largest entry, whose square cannot underflow. Zero stays zero, of length one."""
    largest = max(abs(q[0]), abs(q[1]), abs(q[2]), abs(q[3]))
    if largest == 0:
        return q, largest + 1
    scaled = (q[0] / largest, q[1] / largest, q[2] / largest, q[3] / largest)
    length = np.sqrt(_dot(scaled, scaled))
    return (scaled[0] / length, scaled[1] / length, scaled[2] / length, scaled[3] / length), largest * length


@njit(inline="always", **FAST)
def _unit_adjoint(unit: Quaternion, length: float, g: Quaternion) -> Quaternion:
    """The adjoint of u = q / |q|: (g - u <u, g>) / |q|."""
    along = _dot(unit, g)
    return (
        (g[0] - unit[0] * along) / length,
        (g[1] - unit[1] * along) / length,
        (g[2] - unit[2] * along) / length,
        (g[3] - unit[3] * along) / length,
    )


@njit(inline="always", **FAST)
def _heaviest(point_quats: np.ndarray, weights: np.ndarray, index: np.ndarray, n: int) -> Quaternion:
    """The quaternion of the heaviest neighbour of Gaussian n, to which the others' signs are aligned."""
    best = 0
    for k in range(1, index.shape[1]):
        if weights[n, k] > weights[n, best]:
            best = k
    return _row(point_quats, index[n, best])


@njit(inline="always", **FAST)
def _blended(
    point_quats: np.ndarray, weights: np.ndarray, index: np.ndarray, n: int, reference: Quaternion
) -> Quaternion:
    """Sign-aligned weighted sum of the neighbours' quaternions of Gaussian n."""
    zero = weights[n, 0] * 0
    b0, b1, b2, b3 = zero, zero, zero, zero
    for k in range(index.shape[1]):
        r = _row(point_quats, index[n, k])
        w = -weights[n, k] if _dot(r, reference) < 0 else weights[n, k]
        b0 += w * r[0]
        b1 += w * r[1]
        b2 += w * r[2]
        b3 += w * r[3]
    return b0, b1, b2, b3


@njit(parallel=True, **FAST)
def softmax_weights(sq_dist: np.ndarray, inverse_sq_radii: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Weights [N, K]: softmax of -sq_dist / 2 times the neighbour's inverse squared radius [P]."""
    N, K = index.shape
    weights = np.empty_like(sq_dist)
    for n in prange(N):
        largest = -np.inf
        for k in range(K):
            weights[n, k] = -0.5 * sq_dist[n, k] * inverse_sq_radii[index[n, k]]
            largest = max(largest, weights[n, k])
        total = 0.0
        for k in range(K):
            weights[n, k] = np.exp(weights[n, k] - largest)
            total += weights[n, k]
        for k in range(K):
            weights[n, k] /= total
    return weights


@njit(parallel=True, **FAST)
def softmax_weights_adjoint(
    sq_dist: np.ndarray, inverse_sq_radii: np.ndarray, index: np.ndarray, weights: np.ndarray, g_weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Gradients of sq_dist [N, K] and inverse_sq_radii [P], given that of the weights [N, K]."""
    N, K = index.shape
    g_sq_dist = np.empty_like(sq_dist)
    scattered = np.zeros((CHUNKS, len(inverse_sq_radii)), sq_dist.dtype)
    for chunk in prange(CHUNKS):
        for n in range(chunk * N // CHUNKS, (chunk + 1) * N // CHUNKS):
            mean = 0.0
            for k in range(K):
                mean += weights[n, k] * g_weights[n, k]
            for k in range(K):
                g_exponent = weights[n, k] * (g_weights[n, k] - mean)
                g_sq_dist[n, k] = -0.5 * inverse_sq_radii[index[n, k]] * g_exponent
                scattered[chunk, index[n, k]] -= 0.5 * sq_dist[n, k] * g_exponent
    return g_sq_dist, scattered.sum(axis=0)


@njit(parallel=True, **FAST)
def blend(
    means: np.ndarray,
    quats: np.ndarray,
    rotations: np.ndarray,
    points: np.ndarray,
    moved_points: np.ndarray,
    point_quats: np.ndarray,
    weights: np.ndarray,
    index: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """means' [N, 3] and unit quats' [N, 4]; arguments as in `lbs.blend`, rotations [P, 3, 3], moved_points = p + T."""
    N, K = index.shape
    moved, turned = np.empty_like(means), np.empty_like(quats)
    for n in prange(N):
        moved[n] = 0
        for k in range(K):
            m, w = index[n, k], weights[n, k]
            x, y, z = means[n, 0] - points[m, 0], means[n, 1] - points[m, 1], means[n, 2] - points[m, 2]
            for a in range(3):
                turned_local = rotations[m, a, 0] * x + rotations[m, a, 1] * y + rotations[m, a, 2] * z
                moved[n, a] += w * (moved_points[m, a] + turned_local)
        reference = _heaviest(point_quats, weights, index, n)
        unit_blended, _ = _unit(_blended(point_quats, weights, index, n, reference))
        unit, _ = _unit(_row(quats, n))
        q = _product(unit_blended, unit)
        for c in range(4):
            turned[n, c] = q[c]
    return moved, turned


@njit(parallel=True, **FAST)
def blend_adjoint(
    means: np.ndarray,
    quats: np.ndarray,
    rotations: np.ndarray,
    points: np.ndarray,
    moved_points: np.ndarray,
    point_quats: np.ndarray,
    weights: np.ndarray,
    index: np.ndarray,
    g_moved: np.ndarray,
    g_turned: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gradients of the first seven arguments of `blend`, given those of its results [N, 3] and [N, 4]."""
    N, K = index.shape
    g_means, g_quats, g_weights = np.empty_like(means), np.empty_like(quats), np.empty_like(weights)
    # Per chunk and control point: rotation 0:9, point 9:12, moved point 12:15, quaternion 15:19.
    scattered = np.zeros((CHUNKS, len(points), 19), means.dtype)
    for chunk in prange(CHUNKS):
        for n in range(chunk * N // CHUNKS, (chunk + 1) * N // CHUNKS):
            _position_adjoint(
                n, means, rotations, points, moved_points, weights, index, g_moved, g_means, g_weights, scattered[chunk]
            )
            reference = _heaviest(point_quats, weights, index, n)
            unit_blended, blended_length = _unit(_blended(point_quats, weights, index, n, reference))
            unit, length = _unit(_row(quats, n))
            g = _row(g_turned, n)  # the adjoint of a x b is g x conj(b) in a, and conj(a) x g in b
            g_blended = _unit_adjoint(unit_blended, blended_length, _product(g, _conjugate(unit)))
            g_quat = _unit_adjoint(unit, length, _product(_conjugate(unit_blended), g))
            for c in range(4):
                g_quats[n, c] = g_quat[c]
            for k in range(K):
                r = _row(point_quats, index[n, k])
                sign = -1 if _dot(r, reference) < 0 else 1
                g_weights[n, k] += sign * _dot(r, g_blended)
                for c in range(4):
                    scattered[chunk, index[n, k], 15 + c] += sign * weights[n, k] * g_blended[c]
    total = scattered.sum(axis=0)
    g_rotations = np.ascontiguousarray(total[:, :9]).reshape(-1, 3, 3)
    return g_means, g_quats, g_rotations, total[:, 9:12].copy(), total[:, 12:15].copy(), total[:, 15:].copy(), g_weights


@njit(inline="always", **FAST)
def _position_adjoint(
    n: int,
    means: np.ndarray,
    rotations: np.ndarray,
    points: np.ndarray,
    moved_points: np.ndarray,
    weights: np.ndarray,
    index: np.ndarray,
    g_moved: np.ndarray,
    g_means: np.ndarray,
    g_weights: np.ndarray,
    scattered: np.ndarray,
) -> None:
    """Adjoint of mu' = sum_k w_k (R_k (mu - p_k) + p_k + T_k) for one Gaussian; sets its rows, adds to `scattered`."""
    g_means[n] = 0
    for k in range(index.shape[1]):
        m, w = index[n, k], weights[n, k]
        x, y, z = means[n, 0] - points[m, 0], means[n, 1] - points[m, 1], means[n, 2] - points[m, 2]
        g_weights[n, k] = 0
        for a in range(3):
            g, r0, r1, r2 = g_moved[n, a], rotations[m, a, 0], rotations[m, a, 1], rotations[m, a, 2]
            g_weights[n, k] += g * (moved_points[m, a] + r0 * x + r1 * y + r2 * z)
            g = w * g
            scattered[m, 3 * a] += g * x
            scattered[m, 3 * a + 1] += g * y
            scattered[m, 3 * a + 2] += g * z
            scattered[m, 12 + a] += g
            g_means[n, 0] += g * r0
            g_means[n, 1] += g * r1
            g_means[n, 2] += g * r2
            scattered[m, 9] -= g * r0
            scattered[m, 10] -= g * r1
            scattered[m, 11] -= g * r2
