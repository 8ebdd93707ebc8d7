"""Similarities of space, many at once: products, inverses, logarithms and adjoints."""

from typing import NamedTuple

import numpy as np

from stages.shared import lie


class Similarities(NamedTuple):
    """Similarities x -> s R x + t: s [n], R [n, 3, 3], t [n, 3]."""

    s: np.ndarray
    R: np.ndarray
    t: np.ndarray

    def __matmul__(self, other: "Similarities") -> "Similarities":
        turned = np.einsum("nab,nb->na", self.R, other.t)
        return Similarities(self.s * other.s, self.R @ other.R, self.s[:, None] * turned + self.t)

    def inverse(self) -> "Similarities":
        """The inverse of each."""
        R = np.swapaxes(self.R, 1, 2)
        return Similarities(1 / self.s, R, -np.einsum("nab,nb->na", R, self.t) / self.s[:, None])

    def at(self, index: np.ndarray) -> "Similarities":
        """Some of them."""
        return Similarities(self.s[index], self.R[index], self.t[index])

    def log(self) -> np.ndarray:
        """(translation, rotation vector, logarithm of the scale) [n, 7]."""
        return np.concatenate([self.t, lie.log_so3(self.R), np.log(self.s)[:, None]], axis=1)

    def adjoint(self) -> np.ndarray:
        """[n, 7, 7] that takes a small step on the right of each to the same step on its left."""
        A = np.zeros((len(self.s), 7, 7))
        A[:, :3, :3] = self.s[:, None, None] * self.R
        A[:, :3, 3:6] = lie.skew(self.t) @ self.R
        A[:, :3, 6] = -self.t
        A[:, 3:6, 3:6] = self.R
        A[:, 6, 6] = 1
        return A
