"""Black bars around the picture, which stay black in all frames."""

import numpy as np

BLACK = 16
"""Brightest grey level of a bar: coding adds a few levels to black."""
PICTURE = 48
"""Least brightness, over all frames, of the first row of the picture: a dark picture has no such edge."""
MARGIN_PX = 2
"""Cut off besides: rows into which scaling has mixed the bar."""
LARGEST = 0.4
"""Largest share of the height or width that one bar may take."""


class BrightestYet:
    """The brightest grey level of every row and column over the frames seen so far."""

    def __init__(self) -> None:
        self.rows = self.columns = np.zeros(0, np.uint8)

    def see(self, grey: np.ndarray) -> None:
        """Take in a frame [H, W] uint8. A frame of another size starts anew."""
        rows, columns = grey.max(axis=1), grey.max(axis=0)
        same = len(rows) == len(self.rows) and len(columns) == len(self.columns)
        self.rows = np.maximum(rows, self.rows) if same else rows
        self.columns = np.maximum(columns, self.columns) if same else columns

    def bars_px(self) -> tuple[int, int]:
        """Width of the bars left and right, and height of those above and below, to cut off on either side."""
        return bar_px(self.columns), bar_px(self.rows)


def bar_px(brightest: np.ndarray) -> int:
    """Thickness of the bars at both ends of a row or column of pixels, from the brightest level [n] of each; 0 if none.

    Both ends lose the same: the principal point stays in the middle. A bar at one end alone is kept.
    """
    light = np.flatnonzero(brightest > BLACK)
    if len(light) < 3:
        return 0
    first, last = int(light[0]), int(light[-1])
    thickness = min(first, len(brightest) - 1 - last)
    edges = brightest[first + 1], brightest[last - 1]  # beside rows that scaling may have mixed
    if thickness == 0 or thickness > LARGEST * len(brightest) or min(edges) < PICTURE:
        return 0
    return thickness + MARGIN_PX
