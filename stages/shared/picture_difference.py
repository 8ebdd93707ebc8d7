"""What two pictures of one thing may differ by: exposure, and what a small error of position makes of an edge."""

import cv2
import numpy as np

TOLERANCE = 1.0, 0.5
"""Residual expected of a pixel that is matched right: colour levels, and the position error in pixels."""
SLOPE_PX = 5
"""Each way, the pixels over which the slope of the colours is averaged."""
LEAST_CONTRAST, GAINS = 8.0, (0.5, 2.0)
"""Colour levels between the halves of a picture from which on they tell a gain, and its bounds."""
MEAN_OF_COLOURS = np.full((1, 3), 1 / 3, np.float32)


def difference(found: np.ndarray, expected: np.ndarray, window_px: int) -> np.ndarray:
    """Mean difference [h, w] in colour levels between two pictures [h, w, 3] uint8 over a square around each pixel."""
    colours = cv2.transform(cv2.absdiff(found, expected), MEAN_OF_COLOURS)
    return np.asarray(cv2.boxFilter(colours, cv2.CV_32F, (window_px, window_px)))


def exposed(frame: np.ndarray, other: np.ndarray) -> np.ndarray:
    """A frame [h, w, 3] uint8 corrected to the exposure of the other, which shows the same pixels: per colour a gain,
    from the medians of the brighter and of the darker half of its pixels, and the difference of the medians."""
    here, there = (image[::3, ::3].reshape(-1, 3) for image in (frame, other))
    corrected = [_line(here[:, c], there[:, c]) for c in range(3)]
    table = np.stack([gain * np.arange(256) + offset for gain, offset in corrected], axis=-1)
    return np.asarray(cv2.LUT(frame, np.clip(np.rint(table), 0, 255).astype(np.uint8)[None]))


def _line(here: np.ndarray, there: np.ndarray) -> tuple[float, float]:
    """Gain and offset that take the levels [n] of one picture to those [n] of the other."""
    middle = np.median(here)
    bright = here > middle
    gain = 1.0
    if bright.any() and not bright.all():
        apart = np.median(here[bright]) - np.median(here[~bright])
        if apart >= LEAST_CONTRAST:
            gain = float(np.clip((np.median(there[bright]) - np.median(there[~bright])) / apart, *GAINS))
    return gain, float(np.median(there) - gain * middle)


def tolerance(frame: np.ndarray) -> np.ndarray:
    """Expected residual [h, w], in colour levels, of the right match of each pixel of a frame [h, w, 3]."""
    grey = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
    slope = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=1 / 8))
    levels, pixels = TOLERANCE
    return np.asarray(levels + pixels * cv2.blur(slope, (SLOPE_PX, SLOPE_PX)))
