"""Numba kernels of skinning weights and of what they blend besides motions, with their adjoints."""

import numpy as np
from numba import njit

from stages.shared.quaternion_kernels import FAST
from stages.shared.threads import spread

CHUNKS = 16
"""Partial sums of the scatter into control points: a fixed number, so results do not depend on the thread count."""


def softmax_weights(sq_dist: np.ndarray, inverse_sq_radii: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Weights [N, K]: softmax of -sq_dist / 2 times the neighbour's inverse squared radius [P]."""
    weights = np.empty_like(sq_dist)
    spread(_softmax_weights, len(index), sq_dist, inverse_sq_radii, index, weights)
    return weights


@njit(**FAST)
def _softmax_weights(first: int, last: int, sq_dist: np.ndarray, inverse_sq_radii: np.ndarray, index: np.ndarray,
                     weights: np.ndarray) -> None:  # fmt: skip
    K = index.shape[1]
    for n in range(first, last):
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
    given = sq_dist, inverse_sq_radii, index, weights, g_weights
    spread(_softmax_weights_adjoint, CHUNKS, *given, moving, g_sq_dist, scattered)
    return g_sq_dist, scattered.sum(axis=0)


@njit(**FAST)
def _softmax_weights_adjoint(
    first: int, last: int, sq_dist: np.ndarray, inverse_sq_radii: np.ndarray, index: np.ndarray, weights: np.ndarray,
    g_weights: np.ndarray, moving: bool, g_sq_dist: np.ndarray, scattered: np.ndarray,
) -> None:  # fmt: skip
    N, K = index.shape
    for chunk in range(first, last):
        for n in range(chunk * N // CHUNKS, (chunk + 1) * N // CHUNKS):
            half, mean = sq_dist.dtype.type(0.5), sq_dist.dtype.type(0)
            for k in range(K):
                mean += weights[n, k] * g_weights[n, k]
            for k in range(K):
                g_exponent = weights[n, k] * (g_weights[n, k] - mean)
                if moving:
                    g_sq_dist[n, k] = -half * inverse_sq_radii[index[n, k]] * g_exponent
                scattered[chunk, index[n, k]] -= half * sq_dist[n, k] * g_exponent


def blend_values(values: np.ndarray, weights: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Weighted sums [N, C] of values [P, C] over weights and index [N, K]."""
    blended = np.zeros((len(index), values.shape[1]), values.dtype)
    spread(_blend_values, len(index), values, weights, index, blended)
    return blended


@njit(**FAST)
def _blend_values(first: int, last: int, values: np.ndarray, weights: np.ndarray, index: np.ndarray,
                  blended: np.ndarray) -> None:  # fmt: skip
    K, C = index.shape[1], values.shape[1]
    for n in range(first, last):
        for k in range(K):
            w, p = weights[n, k], index[n, k]
            for c in range(C):
                blended[n, c] += w * values[p, c]


def blend_values_adjoint(g: np.ndarray, weights: np.ndarray, index: np.ndarray, P: int) -> np.ndarray:
    """Gradient [P, C] of the values, given that of the sums [N, C]."""
    scattered = np.zeros((CHUNKS, P, g.shape[1]), g.dtype)
    spread(_blend_values_adjoint, CHUNKS, g, weights, index, scattered)
    return scattered.sum(axis=0)


@njit(**FAST)
def _blend_values_adjoint(first: int, last: int, g: np.ndarray, weights: np.ndarray, index: np.ndarray,
                          scattered: np.ndarray) -> None:  # fmt: skip
    (N, K), C = index.shape, g.shape[1]
    for chunk in range(first, last):
        for n in range(chunk * N // CHUNKS, (chunk + 1) * N // CHUNKS):
            for k in range(K):
                w, p = weights[n, k], index[n, k]
                for c in range(C):
                    scattered[chunk, p, c] += w * g[n, c]
