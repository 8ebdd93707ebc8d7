"""Numba kernel of the gradient record: torch takes a pass over the Gaussians for each of six operations."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def add(first: int, last: int, gradient: np.ndarray, rows: np.ndarray, total: np.ndarray, views: np.ndarray) -> None:
    """Add the lengths of gradients [M, 2] to `total` [N] in the rows [M], each there once; count those above zero."""
    for m in range(first, last):
        x, y = gradient[m, 0], gradient[m, 1]
        length = np.sqrt(x * x + y * y)
        if length > 0:
            total[rows[m]] += length
            views[rows[m]] += 1
