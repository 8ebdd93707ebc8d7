"""How a player turns and mirrors what a video codes: the display matrix of its metadata."""

from typing import Any

import av
import numpy as np

SMALL = 0.05
"""Entries of a display matrix up to this share of the largest count as 0: a turn may be off by 3 degrees."""
AS_CODED = np.eye(2, dtype=int)


def display_matrix(image: av.VideoFrame) -> np.ndarray | None:
    """Signs [2, 2] of the metadata's matrix M: a player shows what is coded at (x, y) at (x, y) M, but for a shift.

    None for turns by other angles than quarters.
    """
    buffer: Any = image.side_data.get("DISPLAYMATRIX")
    if buffer is None:
        return AS_CODED
    matrix = np.frombuffer(buffer, np.int32).reshape(3, 3)[:2, :2].astype(float)
    large = np.abs(matrix) > SMALL * np.abs(matrix).max()
    is_quarter = (large.sum(axis=0) == 1).all() and (large.sum(axis=1) == 1).all()
    return np.where(large, np.sign(matrix), 0).astype(int) if is_quarter else None


def swaps_sides(matrix: np.ndarray | None) -> bool:
    """Whether rows are shown as columns by a `display_matrix`."""
    return matrix is not None and matrix[0, 0] == 0


def as_shown(pixels: np.ndarray, matrix: np.ndarray | None) -> np.ndarray:
    """Pixels [h, w, ...] as a player shows them by a `display_matrix`, mirrored pictures too; None: as they are."""
    if matrix is None:
        return pixels
    if swaps_sides(matrix):
        pixels = pixels.swapaxes(0, 1)
    across, down = matrix.sum(axis=0)
    return pixels[:: int(down), :: int(across)]
