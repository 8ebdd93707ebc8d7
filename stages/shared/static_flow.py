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

    Args:
        A, b: [3, 3] and [3], or [R, 3, 3] and [R, 3] of every row (`rolling`), or of all as one.
    """
    lines = A.reshape(-1, 3, 3).astype(np.float32), b.reshape(-1, 3).astype(np.float32)
    return np.asarray(_dense_static_flow(*lines, inverse_depth.astype(np.float32)))


@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _dense_static_flow(A, b, inverse_depth):  # type: ignore[no-untyped-def]
    flow = np.empty((*inverse_depth.shape, 2), np.float32)
    for y in range(inverse_depth.shape[0]):
        row = min(y, len(A) - 1)
        line, way = A[row], b[row]
        for x in range(inverse_depth.shape[1]):
            u, v, d = np.float32(x), np.float32(y), inverse_depth[y, x]
            Z = max(line[2, 0] * u + line[2, 1] * v + line[2, 2] + d * way[2], np.float32(Z_MIN))
            flow[y, x, 0] = (line[0, 0] * u + line[0, 1] * v + line[0, 2] + d * way[0]) / Z - u
            flow[y, x, 1] = (line[1, 0] * u + line[1, 1] * v + line[1, 2] + d * way[1]) / Z - v
    return flow


def resample(inverse_depth: np.ndarray, cell_px: float, h: int, w: int) -> np.ndarray:
    """Inverse depth [T, rows, columns] of cells of `cell_px` flow pixels on the flow grid, [T, h, w] float32."""
    cells = grid_from_frame(pixel_grid(h, w), cell_px)
    return np.stack([bilinear(d, cells) for d in inverse_depth])
