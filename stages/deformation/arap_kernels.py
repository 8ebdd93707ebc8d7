"""Numba kernels of rigidity: the best rotation of a neighbourhood, the energy and its gradient."""

import numpy as np
from numba import njit

from stages.shared.quaternion_kernels import FAST, rotation
from stages.shared.threads import spread

SWEEPS = 10
"""Jacobi's method converges quadratically: six sweeps of a 4 x 4 matrix reach float64's last digits."""


@njit(inline="always", **FAST)
def _best_rotation(C: np.ndarray, N: np.ndarray, V: np.ndarray, R: np.ndarray) -> None:
    """Set R [3, 3] to the rotation that maximises trace(R C), C [3, 3] = sum_k w_k source_k target_k^T.

    Its quaternion is the eigenvector of the largest eigenvalue of Horn's symmetric matrix N (1987), by Jacobi's
    method: a unit vector, hence a proper rotation, whatever eigenvalues coincide or vanish. N, V: [4, 4] to work in.
    """
    N[0, 0], N[1, 1] = C[0, 0] + C[1, 1] + C[2, 2], C[0, 0] - C[1, 1] - C[2, 2]
    N[2, 2], N[3, 3] = C[1, 1] - C[0, 0] - C[2, 2], C[2, 2] - C[0, 0] - C[1, 1]
    N[0, 1], N[0, 2], N[0, 3] = C[1, 2] - C[2, 1], C[2, 0] - C[0, 2], C[0, 1] - C[1, 0]
    N[1, 2], N[1, 3], N[2, 3] = C[0, 1] + C[1, 0], C[2, 0] + C[0, 2], C[1, 2] + C[2, 1]
    largest = 0.0
    for a in range(4):
        for b in range(a, 4):
            largest = max(largest, abs(N[a, b]))
    for a in range(4):
        for b in range(4):
            V[a, b] = 1.0 if a == b else 0.0
            if a <= b and largest > 0:
                N[a, b] /= largest
    for _ in range(SWEEPS):
        off = 0.0
        for a in range(3):
            for b in range(a + 1, 4):
                off += abs(N[a, b])
                _rotate(N, V, a, b)
        if off < 1e-15:
            break
    best = 0
    for a in range(1, 4):
        if N[a, a] > N[best, best]:
            best = a
    rows = rotation((V[0, best], V[1, best], V[2, best], V[3, best]))
    R[0, 0], R[0, 1], R[0, 2] = rows[0]
    R[1, 0], R[1, 1], R[1, 2] = rows[1]
    R[2, 0], R[2, 1], R[2, 2] = rows[2]


@njit(inline="always", **FAST)
def _rotate(N: np.ndarray, V: np.ndarray, a: int, b: int) -> None:
    """One Jacobi rotation: makes N[a, b], kept in the upper triangle alone, zero; turns the columns of V along."""
    if abs(N[a, b]) < 1e-300:
        return
    theta = (N[b, b] - N[a, a]) / (2 * N[a, b])
    t = 1 / (abs(theta) + np.sqrt(theta * theta + 1))
    if theta < 0:
        t = -t
    c = 1 / np.sqrt(t * t + 1)
    s = t * c
    N[a, a] -= t * N[a, b]
    N[b, b] += t * N[a, b]
    N[a, b] = 0
    for k in range(4):
        V[k, a], V[k, b] = c * V[k, a] - s * V[k, b], s * V[k, a] + c * V[k, b]
        if k != a and k != b:
            i, j = min(k, a), max(k, a)
            m, n = min(k, b), max(k, b)
            N[i, j], N[m, n] = c * N[i, j] - s * N[m, n], s * N[i, j] + c * N[m, n]


def best_rotations(covariances: np.ndarray) -> np.ndarray:
    """Rotations [n, 3, 3] that maximise trace(R C) for C [n, 3, 3] float64, sum_k w_k source_k target_k^T."""
    rotations = np.empty_like(covariances)
    _best_rotations(covariances, np.empty((4, 4)), np.empty((4, 4)), rotations)
    return rotations


@njit(**FAST)
def _best_rotations(covariances: np.ndarray, N: np.ndarray, V: np.ndarray, rotations: np.ndarray) -> None:
    for n in range(len(covariances)):
        _best_rotation(covariances[n], N, V, rotations[n])


def energy(states: np.ndarray, index: np.ndarray, weights: np.ndarray) -> tuple[float, np.ndarray]:
    """The energy of `arap.arap_energy` and its gradient [B, P, 3], all arguments float64 but the index [P, K]."""
    (B, P, _), K = states.shape, index.shape[1]
    totals, gradient = np.zeros((B - 1, P)), np.zeros((B, P, 3))
    residuals, rotations = np.empty((B - 1, P, K, 3)), np.empty((B - 1, P, 3, 3))
    index = np.ascontiguousarray(index)
    spread(_energy, P, states, index, weights, residuals, rotations, totals)
    _gradient(index, residuals, rotations, gradient)
    return float(totals.mean()), gradient


@njit(**FAST)
def _energy(first: int, last: int, states: np.ndarray, index: np.ndarray, weights: np.ndarray, residuals: np.ndarray,
            rotations: np.ndarray, totals: np.ndarray) -> None:  # fmt: skip
    """Add to the energy of every step and point; residuals [B - 1, P, K, 3] times the weight."""
    C, N, V = np.empty((3, 3)), np.empty((4, 4)), np.empty((4, 4))
    B, K = len(states), index.shape[1]
    for p in range(first, last):
        for b in range(B - 1):
            for i in range(3):
                for j in range(3):
                    C[i, j] = 0
            for k in range(K):
                for i in range(3):
                    for j in range(3):
                        before = states[b, p, i] - states[b, index[p, k], i]
                        C[i, j] += weights[p, k] * before * (states[b + 1, p, j] - states[b + 1, index[p, k], j])
            R = rotations[b, p]
            _best_rotation(C, N, V, R)
            for k in range(K):
                for i in range(3):
                    r = states[b + 1, p, i] - states[b + 1, index[p, k], i]
                    for j in range(3):
                        r -= R[i, j] * (states[b, p, j] - states[b, index[p, k], j])
                    residuals[b, p, k, i] = weights[p, k] * r
                    totals[b, p] += weights[p, k] * r * r


@njit(**FAST)
def _gradient(index: np.ndarray, residuals: np.ndarray, rotations: np.ndarray, gradient: np.ndarray) -> None:
    """Add to the gradient [B, P, 3], in a fixed order: neighbours share points."""
    steps, P, K, _ = residuals.shape
    share = 2.0 / (steps * P)
    for b in range(steps):
        for p in range(P):
            for k in range(K):
                for i in range(3):
                    g = share * residuals[b, p, k, i]
                    gradient[b + 1, p, i] += g
                    gradient[b + 1, index[p, k], i] -= g
                    for j in range(3):
                        turned = g * rotations[b, p, i, j]
                        gradient[b, p, j] -= turned
                        gradient[b, index[p, k], j] += turned
