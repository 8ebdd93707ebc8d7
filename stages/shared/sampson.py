"""Sampson distance: first-order distance of a match from an epipolar geometry (Hartley and Zisserman, 11.4.3)."""

import numpy as np
from numba import njit

Terms = tuple[float, float, float, float, float, float]


def sampson_distances(F: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Signed Sampson distances [...] of matches x, y [..., 2] from y^T F x = 0, in the unit and dtype of the matches.

    Args:
        F: [3, 3], a fundamental matrix for matches in pixels, or an essential matrix for rays with z = 1.
    """
    flat = _distances(np.ascontiguousarray(F), np.reshape(x, (-1, 2)), np.reshape(y, (-1, 2)))
    return np.asarray(flat.reshape(x.shape[:-1]))


@njit(cache=True, nogil=True, error_model="numpy")
def _distances(F: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    distances = np.empty(len(x), x.dtype)
    for k in range(len(x)):
        product, length, _, _, _, _ = sampson_terms(F, x[k, 0], x[k, 1], y[k, 0], y[k, 1])
        distances[k] = product / length
    return distances


@njit(inline="always")
def sampson_terms(F: np.ndarray, u: float, v: float, s: float, t: float) -> Terms:
    """Parts of the Sampson distance of the match x = (u, v, 1), y = (s, t, 1) from F [3, 3].

    Returns:
        the numerator y^T F x; the denominator, which is the norm of the four remaining values; the first two entries of
        F x; the first two of F^T y.
    """
    a, b = F[0, 0] * u + F[0, 1] * v + F[0, 2], F[1, 0] * u + F[1, 1] * v + F[1, 2]
    c = F[2, 0] * u + F[2, 1] * v + F[2, 2]
    d, e = F[0, 0] * s + F[1, 0] * t + F[2, 0], F[0, 1] * s + F[1, 1] * t + F[2, 1]
    return a * s + b * t + c, np.sqrt(max(a * a + b * b + d * d + e * e, 1e-24)), a, b, d, e
