"""Numba kernel of joint bilateral upsampling (Kopf et al. 2007): numpy passes over a frame some forty times."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def upsample(
    first: int,
    last: int,
    grid: np.ndarray,
    grid_image: np.ndarray,
    image: np.ndarray,
    rows: np.ndarray,
    row_weights: np.ndarray,
    columns: np.ndarray,
    column_weights: np.ndarray,
    like: float,
    unlike_weight: float,
    upsampled: np.ndarray,
) -> None:
    """Rows first..last - 1 of upsampled [H, W]: the mean of the four grid pixels around each pixel, like ones first.

    Args:
        grid: [h, w]. grid_image: [h, w, 3] and image: [H, W, 3], float32 in 0..1.
        rows, columns: [2, H] and [2, W], the grid indices around each pixel, with their linear weights.
        like: 1 / (2 std^2) of the colour weights, to which unlike_weight is added.
    """
    for y in range(first, last):
        for x in range(image.shape[1]):
            total, weight = 0.0, 0.0
            for k in range(2):
                for m in range(2):
                    v, u = rows[k, y], columns[m, x]
                    squared = np.float32(0)
                    for c in range(3):
                        squared += (image[y, x, c] - grid_image[v, u, c]) ** 2
                    w = row_weights[k, y] * column_weights[m, x] * (np.exp(-like * squared) + unlike_weight)
                    total += w * grid[v, u]
                    weight += w
            upsampled[y, x] = total / weight
