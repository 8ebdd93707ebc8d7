"""Substitution with a triangular band matrix for many right-hand sides at once; LAPACK's takes one after the other.

A band L [width + 1, n] holds element (i, j) at (i - j, j). In the order of Fortran its memory is also that of a matrix
whose columns are `width` long: blocks as long as that are views of it, triangles on the diagonal and triangles beside.
"""

from collections.abc import Iterator

import numpy as np
from numpy.lib.stride_tricks import as_strided
from scipy.linalg.blas import dtrmm, dtrsm


def forward(L: np.ndarray, sides: np.ndarray, first: np.ndarray | None = None) -> np.ndarray:
    """Solutions [n, m] of L x = sides [n, m].

    Args:
        first: [m] row of the first non-zero of every side, ascending, above which nothing is computed; None: 0.
    """
    found = np.array(sides, float)
    starts = np.zeros(sides.shape[1], int) if first is None else first
    for top, bottom in _blocks(L):
        part = found[top:bottom, : np.searchsorted(starts, bottom)]
        if top:
            above = found[top - len(L) + 1 : top, : np.searchsorted(starts, top)]
            part[:, : above.shape[1]] -= dtrmm(1.0, _square(L, top, top - len(L) + 1), above)[: len(part)]
        part[:] = dtrsm(1.0, _square(L, top, top, bottom - top), part, lower=1)
    return found


def backward(L: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Solutions [n, m] of L^T x = sides [n, m]."""
    found = np.array(sides, float)
    for top, bottom in reversed(list(_blocks(L))):
        part = found[top:bottom]
        if bottom < len(found):
            below = np.zeros((len(L) - 1, sides.shape[1]))
            below[: len(found) - bottom] = found[bottom : bottom + len(below)]
            part -= dtrmm(1.0, _square(L, bottom, top), below, trans_a=1)
        part[:] = dtrsm(1.0, _square(L, top, top, bottom - top), part, lower=1, trans_a=1)
    return found


def _blocks(L: np.ndarray) -> Iterator[tuple[int, int]]:
    """First row and end of blocks as long as the band is wide; the last may be shorter."""
    n = L.shape[1]
    return ((top, min(top + len(L) - 1, n)) for top in range(0, n, len(L) - 1))


def _square(L: np.ndarray, top: int, left: int, size: int | None = None) -> np.ndarray:
    """A view of rows top... and columns left..., `size` or the width long; only what the band holds means anything.

    That is the lower triangle on the diagonal, and the upper one of the block below.
    """
    width, item = len(L) - 1, L.itemsize
    memory = L.T.reshape(-1)[top + left * width :]
    return as_strided(memory, (size or width,) * 2, (item, item * width), writeable=False)
