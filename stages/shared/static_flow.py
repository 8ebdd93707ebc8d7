"""The flow of a static scene at every pixel of a frame, from cameras and inverse depth."""

import numba
import numpy as np

from stages.shared.cameras import grid_from_frame, pixel_grid
from stages.shared.warp import bilinear

Z_MIN = 0.05
"""Least ratio of the z-depths in target and source."""


def dense_static_flow(A: np.ndarray, b: np.ndarray, inverse_depth: np.ndarray) -> np.ndarray:
    """`cameras.static_flow` of every pixel of an inverse depth [h, w], as a kernel in float32, [h, w, 2].

    In a sixtieth of the time; a test compares both. What comes nearer to the target than Z_MIN times its depth is held
    there.
    """
    return np.asarray(_dense_static_flow(A.astype(np.float32), b.astype(np.float32), inverse_depth.astype(np.float32)))


@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _dense_static_flow(A, b, inverse_depth):  # type: ignore[no-untyped-def]
    flow = np.empty((*inverse_depth.shape, 2), np.float32)
    for y in range(inverse_depth.shape[0]):
        for x in range(inverse_depth.shape[1]):
            u, v, d = np.float32(x), np.float32(y), inverse_depth[y, x]
            Z = max(A[2, 0] * u + A[2, 1] * v + A[2, 2] + d * b[2], np.float32(Z_MIN))
            flow[y, x, 0] = (A[0, 0] * u + A[0, 1] * v + A[0, 2] + d * b[0]) / Z - u
            flow[y, x, 1] = (A[1, 0] * u + A[1, 1] * v + A[1, 2] + d * b[1]) / Z - v
    return flow


def resample(inverse_depth: np.ndarray, cell_px: float, h: int, w: int) -> np.ndarray:
    """Inverse depth [T, rows, columns] of cells of `cell_px` flow pixels on the flow grid, [T, h, w] float32."""
    cells = grid_from_frame(pixel_grid(h, w), cell_px)
    return np.stack([bilinear(d, cells) for d in inverse_depth])
