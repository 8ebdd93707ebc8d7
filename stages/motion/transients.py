"""What a single frame shows: a thing that moves farther from frame to frame than its own size.

Flow loses it, and without flow nothing tells that it moves but the pictures. At the depth of the static scene the other
frames agree with one another on what is there, and this one shows something else, which neither flow nor the static
depths around find in them: the subtraction of a background, of which each depth has its own. Thin static things in
front, whose flow and depth are both lost, look like that, too, until their depth is searched for (`swept`). Grey levels
are compared: a thing of another colour that is as bright as what is behind it is not told.
"""

import cv2
import numpy as np

from stages.shared.image_noise import BRIGHT, DARK
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
LEAST_FRAMES, MOST = 3, 0.2
"""Other frames that must show a pixel, at least; share of a frame that may be odd, at most."""
WINDOW_PX = 3
"""Of the means of differences."""


class Others:
    """What the other frames show at static depths, compared with one frame.

    Attributes:
        dark, bright: [h, w] where the frame is saturated.
        change, square: [depths, h, w] sums, over the other frames, of the change of grey level and of its square.
        count: [2, depths, h, w] of the earlier and of the later frames that show a pixel.
    """

    def __init__(self, depths: int, frame: np.ndarray) -> None:
        """Nothing yet beside a frame [h, w, 3] uint8."""
        self.dark, self.bright = _between(frame, 0, DARK), _between(frame, BRIGHT, 255)
        self.change, self.square = np.zeros((2, depths, *self.dark.shape), np.float32)
        self.count = np.zeros((2, depths, *self.dark.shape), np.float32)

    def add(self, later: bool, depth: int, found: np.ndarray, expected: np.ndarray, inside: np.ndarray) -> None:
        """Add an earlier or later frame as seen at a depth, `found` [h, w, 3] uint8 where `inside` [h, w], beside the
        `expected`: this frame at the exposure of the other. Where both are saturated nothing is compared."""
        saturated = (self.dark & _between(found, 0, DARK)) | (self.bright & _between(found, BRIGHT, 255))
        seen = inside & ~saturated
        change = cv2.transform(cv2.subtract(found, expected, dtype=cv2.CV_32F), MEAN_OF_COLOURS) * seen
        self.change[depth] += change
        self.square[depth] += change**2
        self.count[int(later), depth] += seen

    def odd(self, residual: np.ndarray, tolerance: np.ndarray) -> np.ndarray:
        """How surely [h, w], 0..1, the frame is the odd one: something passes before a scene that the others agree on.

        Only what earlier and later frames show tells: what is covered in all later ones looks odd in the first. If more
        than a share MOST of the frame is odd, it is the frame, blurred or badly placed, and no thing in it.

        Args:
            residual: [h, w] least residual to the other frames, at the static depths and along the flow, and its
                tolerance, both in colour levels.
        """
        frames, seen = self.count.sum(axis=0), (self.count > 0).all(axis=0)
        seen &= frames >= LEAST_FRAMES
        if not seen.any():
            return np.zeros(residual.shape, np.float32)
        mean = self.change / np.maximum(frames, 1)
        spread = np.sqrt(np.maximum(self.square / np.maximum(frames, 1) - mean**2, 0))
        window, least = (WINDOW_PX, WINDOW_PX), FLOOR * tolerance + np.median(spread[seen])
        ratios = [
            cv2.blur(np.abs(of), window) / (cv2.blur(around, window) + least)
            for of, around in zip(mean, spread, strict=True)
        ]
        alone = np.where(seen, ratios, 0).max(axis=0)
        odd = _half_at(residual / tolerance, UNEXPLAINED) * _half_at(alone, ALONE)
        return odd if (odd > 0.5).mean() <= MOST else np.zeros_like(odd)


def _between(image: np.ndarray, low: int, high: int) -> np.ndarray:
    """Where [h, w] bool all colours of an image [h, w, 3] uint8 are at least `low` and at most `high`."""
    return cv2.inRange(image, (low,) * 3, (high,) * 3) > 0


def _half_at(value: np.ndarray, middle: float) -> np.ndarray:
    """A smooth step of values >= 0 from 0 to 1, which is one half at `middle`."""
    power = (value / middle) ** 4
    return np.asarray(power / (1 + power))
