"""The reduced system of a long sequence: a band along the frames, a border of what they share, and dense directions.

Each frame is linked to those that it has edges with, and these to each other. The links of a path lie in a band, also,
in the order of reverse Cuthill and McKee (1969), those of a path that returns. LAPACK factors it in time linear in the
frames. What all frames share, a focal length or a lens, is eliminated last, by its Schur complement, and so are frames
at the ends of loops where these are few beside the width of the band that would hold them. A curvature along a
direction of all unknowns would fill the band: it comes in by the formula of Woodbury. Without it the band may be
singular, as it is in scale; so a curvature along the same direction of a single frame stands in for it meanwhile.
"""

import itertools
from collections.abc import Iterator

import numpy as np
from numba import njit
from scipy.linalg import cho_factor, cho_solve, cholesky_banded, solve_triangular

from stages.ba.band_layout import Layout
from stages.ba.band_solve import backward, forward
from stages.ba.dense_system import FLOOR
from stages.ba.kernel import FAST
from stages.ba.reduced import Term


class BandedSystem:
    """Sum of terms over all unknowns; the same as `dense_system.DenseSystem`."""

    def __init__(self, at: Layout) -> None:
        self.at, self.diagonal = at, np.zeros(len(at.place))
        self.K = np.zeros((at.width + 1, at.band), order="F")
        self.B, self.C = np.zeros((at.band, at.border)), np.zeros((at.border, at.border))
        self.rhs = np.zeros(at.band + at.border)
        self.along: list[tuple[float, np.ndarray]] = []

    def add(self, term: Term) -> None:
        """Add a term."""
        self.diagonal[term.unknowns] += np.diagonal(term.matrix)
        place = self.at.place[term.unknowns]
        _scatter(place, term.matrix, self.K, self.B, self.C)
        self.rhs[place[place >= 0]] += term.gradient[place >= 0]

    def stiffen(self, strength: float, direction: np.ndarray) -> None:
        """Add curvature `strength` along a direction of all unknowns; nothing if it is zero."""
        squared = direction @ direction
        if strength * squared > 0:
            self.diagonal += strength * direction**2 / squared
            free = self.at.place >= 0
            u = np.zeros(len(self.rhs))
            u[self.at.place[free]] = direction[free]
            if u.any():
                self.along.append((strength * float(u @ u / squared), u / np.linalg.norm(u)))

    def step(self, damping: float, ridge: float) -> np.ndarray:
        """Step of all unknowns with Levenberg-Marquardt damping, and a share `ridge` of the mean curvature.

        It is zero for those that are not free.

        Raises:
            numpy.linalg.LinAlgError: if the damped system is not positive definite.
        """
        diagonal = self._free_diagonal()
        factor = Factor(self, damping * diagonal + ridge * diagonal.mean() + 1e-300)
        step, free = np.zeros(len(self.at.place)), self.at.place >= 0
        step[free] = factor.solve(self.rhs)[self.at.place[free]]
        return step

    def covariance(self) -> "BandedCovariance":
        """The inverse of the system, with a curvature of `FLOOR` of the mean more; of more where rounding needs it."""
        added = FLOOR * max(float(self._free_diagonal().mean()), 1e-300)
        while True:
            try:
                return BandedCovariance(self, Factor(self, np.full(len(self.rhs), added)))
            except np.linalg.LinAlgError:
                added *= 10

    def _free_diagonal(self) -> np.ndarray:
        diagonal, free = np.zeros(len(self.rhs)), self.at.place >= 0
        diagonal[self.at.place[free]] = self.diagonal[free]
        return diagonal


class Factor:
    """The factored system with `added` [m] on its diagonal.

    Raises:
        numpy.linalg.LinAlgError: if it is not positive definite.
    """

    def __init__(self, system: BandedSystem, added: np.ndarray) -> None:
        n, K = system.at.band, system.K.copy(order="F")
        K[0] += added[:n]
        strength = float(system.diagonal.mean())
        pins = [_pin(system.at, u) for _, u in system.along]
        for pin in pins:
            chosen = np.flatnonzero(pin)
            _scatter(chosen, strength * np.outer(pin[chosen], pin[chosen]), K, system.B, system.C)
        self.L = cholesky_banded(K, overwrite_ab=True, lower=True, check_finite=False)
        self.W = forward(self.L, system.B, system.at.first)
        self.rest = cho_factor(system.C + np.diag(added[n:]) - self.W.T @ self.W, check_finite=False)
        self.U = np.array([u for _, u in system.along] + pins).reshape(-1, len(added)).T
        self.V = self._pinned(self.U)
        inverse = [1 / curvature for curvature, _ in system.along] + [-1 / strength] * len(pins)
        self.G = np.diag(inverse) + self.U.T @ self.V

    def _pinned(self, rhs: np.ndarray) -> np.ndarray:
        """Solution for right-hand sides [m, k] of the band with its border, with pins in place of the directions."""
        n = len(self.W)
        band = forward(self.L, rhs[:n])
        border = cho_solve(self.rest, rhs[n:] - self.W.T @ band, check_finite=False)
        return np.concatenate([backward(self.L, band - self.W @ border), border])

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        """Solution for right-hand sides [m] or [m, k]."""
        found = self._pinned(rhs.reshape(len(rhs), -1)).reshape(rhs.shape)
        return found if not len(self.G) else found - self.V @ np.linalg.solve(self.G, self.U.T @ found)


class BandedCovariance:
    """The inverse of a system, of which only what is asked for is computed; zero for unknowns that are not free."""

    def __init__(self, system: BandedSystem, factor: Factor) -> None:
        self.at, self.factor = system.at, factor

    def of(self, directions: np.ndarray) -> np.ndarray:
        """Covariance [k, k] of k linear combinations [k, n] of all unknowns."""
        free = self.at.place >= 0
        columns = np.zeros((len(self.factor.U), len(directions)))
        columns[self.at.place[free]] = directions.T[free]
        return np.asarray(columns.T @ self.factor.solve(columns))

    def poses(self, T: int) -> np.ndarray:
        """Covariance [T, 6, 6] of the twist of every pose."""
        factor, found, place = self.factor, np.zeros((T, 6, 6)), self.at.place[: 6 * T].reshape(T, 6)
        rest = cho_solve(factor.rest, np.eye(self.at.border), check_finite=False)
        by_border = np.concatenate([backward(factor.L, factor.W), np.zeros_like(rest)])
        shared = by_border @ rest
        dense = np.linalg.solve(factor.G, factor.V.T).T if len(factor.G) else factor.V
        for first, block in itertools.chain(self._diagonal_blocks(), [(self.at.band, rest)]):
            inside = (place >= first) & (place < first + len(block))
            for frame in np.flatnonzero(inside.any(axis=1)):
                free = np.flatnonzero(inside[frame])
                at = place[frame, free]
                covariance = block[np.ix_(at - first, at - first)]
                covariance = covariance + shared[at] @ by_border[at].T - dense[at] @ factor.V[at].T
                found[frame][np.ix_(free, free)] = covariance
        return found

    def _diagonal_blocks(self) -> Iterator[tuple[int, np.ndarray]]:
        """Blocks on the diagonal of the inverse of the band, last first, with the place of their first unknown.

        They are wider than the band, so that its factor L has blocks on and next to the diagonal alone. The block of
        the inverse of L L^T then follows from the next one: Z = L_kk^-T L_kk^-1 + G^T Z_next G, G = L_next,k L_kk^-1.
        """
        L, last = self.factor.L, None
        borders = _borders(self.at)
        for first, end in zip(borders[-2::-1], borders[:0:-1], strict=True):
            inverse = solve_triangular(_block(L, first, end, first, end), np.eye(end - first), lower=True)
            block = inverse.T @ inverse
            if last is not None:
                following, Z = last
                G = _block(L, following, following + len(Z), first, end) @ inverse
                block += G.T @ Z @ G
            yield first, block
            last = first, block


def _pin(at: Layout, u: np.ndarray) -> np.ndarray:
    """The direction u [m], of length 1, of the one frame along the band that it moves most."""
    most = np.argmax(np.bincount(at.frame, u[: at.band] ** 2))
    pin = np.zeros(len(u))
    pin[: at.band] = np.where(at.frame == most, u[: at.band], 0)
    return np.asarray(pin / np.linalg.norm(pin))


def _borders(at: Layout) -> list[int]:
    """Places where blocks of whole frames begin that are at least as long as the band is wide, and the end."""
    starts = np.append(np.flatnonzero(np.diff(at.frame, prepend=-1)), at.band).tolist()
    borders = [0]
    for start in starts:
        if start - borders[-1] >= max(at.width, 1):
            borders.append(start)
    if borders[-1] < at.band:
        borders.append(at.band)
    return borders


def _block(L: np.ndarray, top: int, bottom: int, left: int, right: int) -> np.ndarray:
    """Rows top..bottom and columns left..right of a lower triangular matrix stored as a band [width + 1, n]."""
    below = np.arange(top, bottom)[:, None] - np.arange(left, right)
    stored = (below >= 0) & (below < len(L))
    return np.where(stored, L[np.where(stored, below, 0), np.arange(left, right)], 0.0)


@njit(**FAST)
def _scatter(place: np.ndarray, matrix: np.ndarray, K: np.ndarray, B: np.ndarray, C: np.ndarray) -> None:
    """Add a symmetric matrix [n, n] of unknowns at `place` [n], -1: left out, to the band, its border and the rest."""
    band = K.shape[1]
    for a in range(len(place)):
        for b in range(len(place)):
            row, column = place[a], place[b]
            if column >= 0 and row >= column and row < band:
                K[row - column, column] += matrix[a, b]
            elif column >= band and row >= band:
                C[row - band, column - band] += matrix[a, b]
            elif column >= band and 0 <= row < band:
                B[row, column - band] += matrix[a, b]
