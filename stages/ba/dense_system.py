"""The reduced system as a dense matrix: for short sequences, where it is as fast as the banded one.

Its steps are, bit for bit, those of the time when all sequences were solved so.
"""

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from stages.ba.reduced import Term

FLOOR = 1e-12
"""Smallest curvature, relative to the mean, in a covariance: unobserved directions get a large but finite variance."""


class DenseSystem:
    """Sum of terms over all unknowns, of which `free` [m] are solved for: S x = rhs."""

    def __init__(self, size: int, free: np.ndarray) -> None:
        self.S, self.rhs, self.free = np.zeros((size, size)), np.zeros(size), free

    @property
    def diagonal(self) -> np.ndarray:
        """Diagonal of S, of all unknowns."""
        return np.diagonal(self.S)

    def add(self, term: Term) -> None:
        """Add a term."""
        self.S[np.ix_(term.unknowns, term.unknowns)] += term.matrix
        self.rhs[term.unknowns] += term.gradient

    def stiffen(self, strength: float, direction: np.ndarray) -> None:
        """Add curvature `strength` along a direction of all unknowns; nothing if it is zero."""
        squared = direction @ direction
        if squared > 0:
            self.S += strength * np.outer(direction, direction) / squared

    def step(self, damping: float, ridge: float) -> np.ndarray:
        """Step of all unknowns with Levenberg-Marquardt damping, and a share `ridge` of the mean curvature.

        It is zero for those that are not free.

        Raises:
            numpy.linalg.LinAlgError: if the damped system is not positive definite.
        """
        A = self.S[np.ix_(self.free, self.free)]
        A = A + np.diag(damping * np.diag(A) + ridge * np.trace(A) / len(A) + 1e-300)
        step = np.zeros(len(self.rhs))
        step[self.free] = cho_solve(cho_factor(A, check_finite=False), self.rhs[self.free], check_finite=False)
        return step

    def covariance(self) -> "DenseCovariance":
        """The inverse of S, which has a floor of `FLOOR` on its eigenvalues."""
        values, vectors = np.linalg.eigh(self.S[np.ix_(self.free, self.free)])
        floor = FLOOR * max(float(values.mean()), 1e-300)
        full = np.zeros_like(self.S)
        full[np.ix_(self.free, self.free)] = (vectors / np.maximum(values, floor)) @ vectors.T
        return DenseCovariance(full)


class DenseCovariance:
    """Covariance `full` of all unknowns, zero for those that are not free."""

    def __init__(self, full: np.ndarray) -> None:
        self.full = full

    def of(self, directions: np.ndarray) -> np.ndarray:
        """Covariance [k, k] of k linear combinations [k, n] of all unknowns."""
        return np.asarray(directions @ self.full @ directions.T)

    def poses(self, T: int) -> np.ndarray:
        """Covariance [T, 6, 6] of the twist of every pose."""
        twists = self.full[: 6 * T, : 6 * T].reshape(T, 6, T, 6)
        return np.einsum("iaib->iab", twists)
