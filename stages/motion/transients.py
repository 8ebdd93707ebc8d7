"""What a single frame shows: a thing that moves farther from frame to frame than its own size.

Flow loses it, and without flow nothing tells that it moves but the pictures. At the depth of the static scene the other
frames agree with one another on what is there, and this one shows something else, which no static depth and no flow
finds in any of them. Of a median over the frames, as in the subtraction of a background, each depth has its own.
"""

import cv2
import numpy as np

from stages.shared.picture_difference import MEAN_OF_COLOURS

UNEXPLAINED = 1.5
"""Least residual to all other frames, in units of the tolerance, at which it is half certain that nothing explains a
pixel."""
ALONE = 1.5
"""Difference to the mean of the other frames, in units of their own differences, at which it is half certain that this
frame is the odd one."""
FLOOR = 0.5
"""Added to the differences between the other frames, in units of the tolerance, beside their median: few frames may
agree by chance, the more so through noise."""
LEAST_FRAMES = 3
WINDOW_PX = 3


class Others:
    """What the other frames show at static depths, compared with one frame.

    Attributes:
        change, square: [depths, h, w] sums, over the other frames, of the change of grey level and of its square.
        count: [depths, h, w] of the frames that show a pixel.
    """

    def __init__(self, depths: int, shape: tuple[int, ...]) -> None:
        self.change, self.square, self.count = np.zeros((3, depths, *shape), np.float32)

    def add(self, depth: int, found: np.ndarray, expected: np.ndarray, inside: np.ndarray) -> None:
        """Add a frame as seen at a depth, `found` [h, w, 3] uint8 where `inside` [h, w], beside the `expected`."""
        change = cv2.transform(cv2.subtract(found, expected, dtype=cv2.CV_32F), MEAN_OF_COLOURS) * inside
        self.change[depth] += change
        self.square[depth] += change**2
        self.count[depth] += inside

    def odd(self, residual: np.ndarray, tolerance: np.ndarray) -> np.ndarray:
        """How surely [h, w], 0..1, the frame is the odd one: something passes before a scene that the others agree on.

        Args:
            residual: [h, w] least residual to the other frames, at any static depth and along the flow, and its
                tolerance, both in colour levels.
        """
        count = np.maximum(self.count, 1)
        mean = self.change / count
        spread = np.sqrt(np.maximum(self.square / count - mean**2, 0))
        window, least = (WINDOW_PX, WINDOW_PX), FLOOR * tolerance + np.median(spread[0])
        ratios = [
            cv2.blur(np.abs(of), window) / (cv2.blur(around, window) + least)
            for of, around in zip(mean, spread, strict=True)
        ]
        alone = np.where(self.count >= LEAST_FRAMES, ratios, 0).max(axis=0)
        return np.asarray(_half_at(residual / tolerance, UNEXPLAINED) * _half_at(alone, ALONE))


def _half_at(value: np.ndarray, middle: float) -> np.ndarray:
    """A smooth step of values >= 0 from 0 to 1, which is one half at `middle`."""
    power = (value / middle) ** 4
    return np.asarray(power / (1 + power))
