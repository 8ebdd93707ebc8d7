"""Black bars around the picture, which stay black in all frames."""

import numpy as np

BLACK = 16
"""Brightest grey level of a bar: coding adds a few levels to black."""
SHARE = 0.5
"""A bar's rows are black over at least this share of their length: subtitles and time codes may stand on a bar."""
STEP = 0.4
"""Least difference in that share between a bar's last row and the picture's first."""
PICTURE = 48
"""Least brightness, over all frames, of the first row of the picture: a dark picture has no such edge."""
MARGIN_PX = 2
"""Cut off besides: rows into which scaling has mixed the bar."""
LARGEST = 0.4
"""Largest share of the height or width that one bar may take."""


class BrightestYet:
    """The brightest grey level of every pixel over the frames seen so far."""

    def __init__(self) -> None:
        self.levels = np.zeros((0, 0), np.uint8)

    def see(self, grey: np.ndarray) -> None:
        """Take in a frame [H, W] uint8. A frame of another size starts anew."""
        self.levels = np.maximum(grey, self.levels) if grey.shape == self.levels.shape else grey

    def ends_px(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Thickness of the bars: (left, right), (above, below); 0 where there is none."""
        if self.levels.size == 0:
            return (0, 0), (0, 0)
        across = bar_px(self.levels.T), bar_px(self.levels.T[::-1])
        return across, (bar_px(self.levels), bar_px(self.levels[::-1]))

    def bars_px(self) -> tuple[int, int]:
        """What to cut off on either side: left and right alike, above and below alike.

        Both ends lose the same: the principal point stays in the middle. A bar at one end alone is kept.
        """
        thickness = (min(ends) for ends in self.ends_px())
        width, height = (px + MARGIN_PX if px else 0 for px in thickness)
        return width, height


def bar_px(brightest: np.ndarray) -> int:
    """Thickness of a bar at the first rows of an image, from the brightest level [H, W] of each pixel; 0 if none."""
    share = (brightest <= BLACK).mean(axis=1)
    black = share >= SHARE
    thickness = len(black) if black.all() else int(black.argmin())
    if thickness == 0 or thickness > LARGEST * len(black):
        return 0
    beyond = thickness + 1  # beside a row that scaling may have mixed
    sharp = brightest[beyond].max() >= PICTURE and share[beyond] <= share[thickness - 1] - STEP
    return thickness if sharp else 0
