"""Numba kernels of linear blend skinning: weights, the blend of K rigid motions per Gaussian, and their adjoints."""

import numpy as np
from numba import njit, prange

from stages.control.quaternion_kernels import FAST, Quaternion, conjugate, dot, product, row, unit, unit_adjoint

CHUNKS = 16
"""Partial sums of the scatter into control points: a fixed number, so results do not depend on the thread count."""


@njit(inline="always", **FAST)
def _heaviest(weights: np.ndarray, index: np.ndarray, n: int) -> int:
    """The heaviest control point of Gaussian n, to whose quaternion the others' signs are aligned."""
    best = 0
    for k in range(1, index.shape[1]):
        if weights[n, k] > weights[n, best]:
            best = k
    return int(index[n, best])


@njit(inline="always", **FAST)
def _blended(packed: np.ndarray, weights: np.ndarray, index: np.ndarray, n: int, reference: Quaternion) -> Quaternion:
    """Sign-aligned weighted sum of the neighbours' quaternions of Gaussian n."""
    zero = packed.dtype.type(0)
    b0, b1, b2, b3 = zero, zero, zero, zero
    for k in range(index.shape[1]):
        r = _quat(packed, index[n, k])
        w = -weights[n, k] if dot(r, reference) < 0 else weights[n, k]
        b0 += w * r[0]
        b1 += w * r[1]
        b2 += w * r[2]
        b3 += w * r[3]
    return b0, b1, b2, b3


@njit(inline="always", **FAST)
def _quat(packed: np.ndarray, p: int) -> Quaternion:
    return packed[p, 15], packed[p, 16], packed[p, 17], packed[p, 18]


@njit(**FAST)
def _pack(points: np.ndarray, point_quats: np.ndarray, point_translations: np.ndarray) -> np.ndarray:
    """What Gaussians read of a control point, in one place [P, 20]: rotation 0:9, p 9:12, p + T 12:15, quat 15:19."""
    packed = np.empty((len(points), 20), points.dtype)
    for p in range(len(points)):
        w, x, y, z = row(point_quats, p)
        packed[p, 0], packed[p, 1], packed[p, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
        packed[p, 3], packed[p, 4], packed[p, 5] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
        packed[p, 6], packed[p, 7], packed[p, 8] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        for a in range(3):
            packed[p, 9 + a] = points[p, a]
            packed[p, 12 + a] = points[p, a] + point_translations[p, a]
        packed[p, 15:19] = point_quats[p]
    return packed


@njit(**FAST)
def _unpack_adjoint(packed: np.ndarray, g_packed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gradients of p, quaternion and T of each control point, given [P, 16]: of rotation 0:9, p + T 9:12, quat 12:16.

    The gradient of p through mu - p is -R^T times that of p + T, so it needs no sum of its own.
    """
    P = len(packed)
    g_points, g_quats = np.empty((P, 3), packed.dtype), np.empty((P, 4), packed.dtype)
    for p in range(P):
        g = g_packed[p]
        w, x, y, z = _quat(packed, p)
        for a in range(3):
            turned = packed[p, a] * g[9] + packed[p, 3 + a] * g[10] + packed[p, 6 + a] * g[11]
            g_points[p, a] = g[9 + a] - turned
        g_quats[p, 0] = g[12] + 2 * (x * (g[7] - g[5]) + y * (g[2] - g[6]) + z * (g[3] - g[1]))
        g_quats[p, 1] = g[13] + 2 * (y * (g[1] + g[3]) + z * (g[2] + g[6]) + w * (g[7] - g[5]) - 2 * x * (g[4] + g[8]))
        g_quats[p, 2] = g[14] + 2 * (x * (g[1] + g[3]) + z * (g[5] + g[7]) + w * (g[2] - g[6]) - 2 * y * (g[0] + g[8]))
        g_quats[p, 3] = g[15] + 2 * (x * (g[2] + g[6]) + y * (g[5] + g[7]) + w * (g[3] - g[1]) - 2 * z * (g[0] + g[4]))
    return g_points, g_quats, g_packed[:, 9:12].copy()


@njit(parallel=True, **FAST)
def softmax_weights(sq_dist: np.ndarray, inverse_sq_radii: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Weights [N, K]: softmax of -sq_dist / 2 times the neighbour's inverse squared radius [P]."""
    N, K = index.shape
    weights = np.empty_like(sq_dist)
    for n in prange(N):
        half, total = sq_dist.dtype.type(0.5), sq_dist.dtype.type(0)
        for k in range(K):
            weights[n, k] = -half * sq_dist[n, k] * inverse_sq_radii[index[n, k]]
        largest = weights[n, 0]
        for k in range(1, K):
            largest = max(largest, weights[n, k])
        for k in range(K):
            weights[n, k] = np.exp(weights[n, k] - largest)
            total += weights[n, k]
        for k in range(K):
            weights[n, k] /= total
    return weights


@njit(parallel=True, **FAST)
def softmax_weights_adjoint(
    sq_dist: np.ndarray, inverse_sq_radii: np.ndarray, index: np.ndarray, weights: np.ndarray, g_weights: np.ndarray,
    moving: bool,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Gradients of sq_dist [N, K] and inverse_sq_radii [P], given that of the weights [N, K].

    The first is left out, with no row, unless `moving`: Gaussians at rest keep their distances.
    """
    N, K = index.shape
    g_sq_dist = np.empty((N if moving else 0, K), sq_dist.dtype)
    scattered = np.zeros((CHUNKS, len(inverse_sq_radii)), sq_dist.dtype)
    for chunk in prange(CHUNKS):
        for n in range(chunk * N // CHUNKS, (chunk + 1) * N // CHUNKS):
            half, mean = sq_dist.dtype.type(0.5), sq_dist.dtype.type(0)
            for k in range(K):
                mean += weights[n, k] * g_weights[n, k]
            for k in range(K):
                g_exponent = weights[n, k] * (g_weights[n, k] - mean)
                if moving:
                    g_sq_dist[n, k] = -half * inverse_sq_radii[index[n, k]] * g_exponent
                scattered[chunk, index[n, k]] -= half * sq_dist[n, k] * g_exponent
    return g_sq_dist, scattered.sum(axis=0)


@njit(parallel=True, **FAST)
def blend(
    means: np.ndarray,
    quats: np.ndarray,
    points: np.ndarray,
    point_quats: np.ndarray,
    point_translations: np.ndarray,
    weights: np.ndarray,
    index: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """means' [N, 3] and unit quats' [N, 4]; arguments as in `lbs.blend`."""
    N, K = index.shape
    packed = _pack(points, point_quats, point_translations)
    moved, turned = np.empty_like(means), np.empty_like(quats)
    for n in prange(N):
        zero = packed.dtype.type(0)
        m0, m1, m2 = zero, zero, zero
        for k in range(K):
            p, w = index[n, k], weights[n, k]
            x, y, z = means[n, 0] - packed[p, 9], means[n, 1] - packed[p, 10], means[n, 2] - packed[p, 11]
            m0 += w * (packed[p, 12] + packed[p, 0] * x + packed[p, 1] * y + packed[p, 2] * z)
            m1 += w * (packed[p, 13] + packed[p, 3] * x + packed[p, 4] * y + packed[p, 5] * z)
            m2 += w * (packed[p, 14] + packed[p, 6] * x + packed[p, 7] * y + packed[p, 8] * z)
        moved[n, 0], moved[n, 1], moved[n, 2] = m0, m1, m2
        reference = _quat(packed, _heaviest(weights, index, n))
        unit_blended, _ = unit(_blended(packed, weights, index, n, reference))
        own, _ = unit(row(quats, n))
        turned[n, 0], turned[n, 1], turned[n, 2], turned[n, 3] = product(unit_blended, own)
    return moved, turned


@njit(parallel=True, **FAST)
def blend_adjoint(
    means: np.ndarray,
    quats: np.ndarray,
    points: np.ndarray,
    point_quats: np.ndarray,
    point_translations: np.ndarray,
    weights: np.ndarray,
    index: np.ndarray,
    g_moved: np.ndarray,
    g_turned: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gradients of the first six arguments of `blend`, given those of its results [N, 3] and [N, 4]."""
    N = len(index)
    packed = _pack(points, point_quats, point_translations)
    g_means, g_quats, g_weights = np.empty_like(means), np.empty_like(quats), np.empty_like(weights)
    scattered = np.zeros((CHUNKS, len(points), 16), means.dtype)  # as in `_unpack_adjoint`
    for chunk in prange(CHUNKS):
        for n in range(chunk * N // CHUNKS, (chunk + 1) * N // CHUNKS):
            reference = _quat(packed, _heaviest(weights, index, n))
            unit_blended, blended_length = unit(_blended(packed, weights, index, n, reference))
            own, length = unit(row(quats, n))
            g = row(g_turned, n)  # the adjoint of a x b is g x conj(b) in a, and conj(a) x g in b
            g_blended = unit_adjoint(unit_blended, blended_length, product(g, conjugate(own)))
            g_quat = unit_adjoint(own, length, product(conjugate(unit_blended), g))
            g_quats[n, 0], g_quats[n, 1], g_quats[n, 2], g_quats[n, 3] = g_quat
            _neighbours_adjoint(
                n, means, packed, weights, index, g_moved, reference, g_blended, g_means, g_weights, scattered[chunk]
            )
    g_points, g_point_quats, g_translations = _unpack_adjoint(packed, scattered.sum(axis=0))
    return g_means, g_quats, g_points, g_point_quats, g_translations, g_weights


@njit(inline="always", **FAST)
def _neighbours_adjoint(
    n: int,
    means: np.ndarray,
    packed: np.ndarray,
    weights: np.ndarray,
    index: np.ndarray,
    g_moved: np.ndarray,
    reference: Quaternion,
    g_blended: Quaternion,
    g_means: np.ndarray,
    g_weights: np.ndarray,
    scattered: np.ndarray,
) -> None:
    """Adjoint of both sums over the neighbours of one Gaussian; sets its rows, adds to `scattered` [P, 16]."""
    zero = packed.dtype.type(0)
    m0, m1, m2 = zero, zero, zero
    for k in range(index.shape[1]):
        p, w = index[n, k], weights[n, k]
        x, y, z = means[n, 0] - packed[p, 9], means[n, 1] - packed[p, 10], means[n, 2] - packed[p, 11]
        r = _quat(packed, p)
        sign = packed.dtype.type(-1 if dot(r, reference) < 0 else 1)
        g_weight = sign * dot(r, g_blended)
        for a in range(3):
            g, r0, r1, r2 = g_moved[n, a], packed[p, 3 * a], packed[p, 3 * a + 1], packed[p, 3 * a + 2]
            g_weight += g * (packed[p, 12 + a] + r0 * x + r1 * y + r2 * z)
            g = w * g
            m0 += g * r0
            m1 += g * r1
            m2 += g * r2
            scattered[p, 3 * a] += g * x
            scattered[p, 3 * a + 1] += g * y
            scattered[p, 3 * a + 2] += g * z
            scattered[p, 9 + a] += g
        g_weights[n, k] = g_weight
        for c in range(4):
            scattered[p, 12 + c] += sign * w * g_blended[c]
    g_means[n, 0], g_means[n, 1], g_means[n, 2] = m0, m1, m2


@njit(parallel=True, **FAST)
def blend_values(values: np.ndarray, weights: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Weighted sums [N, C] of values [P, C] over weights and index [N, K]."""
    (N, K), C = index.shape, values.shape[1]
    blended = np.zeros((N, C), values.dtype)
    for n in prange(N):
        for k in range(K):
            for c in range(C):
                blended[n, c] += weights[n, k] * values[index[n, k], c]
    return blended


@njit(parallel=True, **FAST)
def blend_values_adjoint(g: np.ndarray, weights: np.ndarray, index: np.ndarray, P: int) -> np.ndarray:
    """Gradient [P, C] of the values, given that of the sums [N, C]."""
    (N, K), C = index.shape, g.shape[1]
    scattered = np.zeros((CHUNKS, P, C), g.dtype)
    for chunk in prange(CHUNKS):
        for n in range(chunk * N // CHUNKS, (chunk + 1) * N // CHUNKS):
            for k in range(K):
                for c in range(C):
                    scattered[chunk, index[n, k], c] += weights[n, k] * g[n, c]
    return scattered.sum(axis=0)
