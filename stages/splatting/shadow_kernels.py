"""Numba kernel of the weights of moving shadows: torch goes over [B, K] a dozen times, on one core."""

import numpy as np
from numba import njit

from stages.shared.quaternion_kernels import FAST, ONE
from stages.shared.threads import spread


def faded_weights(
    means: np.ndarray, rows: np.ndarray, points: np.ndarray, halves: np.ndarray, index: np.ndarray, least: np.float32
) -> np.ndarray:
    """Weights [B, K] in 0..1 of the points nearest to B means: k / (sum k + least), k = max(exp(-h d^2) - least, 0) by
    the squared distance d^2 of a mean and a point.

    Args:
        means: [n, 3] scene units, of which B count. rows: [B] theirs, 0..n-1. points: [S, 3]. index: [B, K], of S.
        halves: [S] h, one over twice the squared kernel radius. least: 0..1, what fades out, and what no point has.
    """
    weights = np.empty(index.shape, np.float32)
    spread(_faded_weights, len(rows), means, rows, points, halves, index, least, weights)
    return weights


@njit(**FAST)
def _faded_weights(first: int, last: int, means: np.ndarray, rows: np.ndarray, points: np.ndarray, halves: np.ndarray,
                   index: np.ndarray, least: np.float32, weights: np.ndarray) -> None:  # fmt: skip
    for b in range(first, last):
        n, total = rows[b], least
        for k in range(index.shape[1]):
            s = index[b, k]
            x, y, z = means[n, 0] - points[s, 0], means[n, 1] - points[s, 1], means[n, 2] - points[s, 2]
            weights[b, k] = max(np.exp(-halves[s] * (x * x + y * y + z * z)) - least, np.float32(0))
            total += weights[b, k]
        share = ONE / total
        for k in range(index.shape[1]):
            weights[b, k] *= share
