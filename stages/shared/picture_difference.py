"""What two pictures of one thing may differ by: exposure, and what a small error of position makes of an edge."""

import cv2
import numba
import numpy as np

from stages.shared.window_kernels import KERNEL

TOLERANCE = 1.0, 0.5
"""Residual expected of a pixel that is matched right: colour levels, and the position error in pixels."""
SLOPE_PX = 5
"""Each way, the pixels over which the slope of the colours is averaged."""
LEAST_CONTRAST, GAINS = 8.0, (0.5, 2.0)
"""Colour levels between the halves of a picture from which on they tell a gain, and its bounds."""
EVERY_PX = 3
"""Of every third pixel each way, the levels are compared: these are enough for medians."""
BRIGHTNESSES = 8
"""Parts, from the darkest to the brightest, of which the noise is measured apart."""
MEAN_OF_COLOURS = np.full((1, 3), 1 / 3, np.float32)


def difference(found: np.ndarray, expected: np.ndarray, window_px: int) -> np.ndarray:
    """Mean difference [h, w] in colour levels between two pictures [h, w, 3] uint8 over a square around each pixel."""
    colours = cv2.transform(cv2.absdiff(found, expected), MEAN_OF_COLOURS)
    return np.asarray(cv2.boxFilter(colours, cv2.CV_32F, (window_px, window_px)))


def exposed(frame: np.ndarray, there: np.ndarray) -> np.ndarray:
    """A frame [h, w, 3] uint8 corrected to the exposure of another: per colour a gain, from the medians of the brighter
    and of the darker half of the pixels, and the difference of the medians.

    Args:
        there: the other picture of the same pixels, [::EVERY_PX, ::EVERY_PX] of it.
    """
    here, counts = frame[::EVERY_PX, ::EVERY_PX], np.empty((6, 256), np.int64)
    corrected = [_line(here[..., c].ravel(), there[..., c].ravel(), counts) for c in range(3)]
    table = np.stack([gain * np.arange(256) + offset for gain, offset in corrected], axis=-1)
    return np.asarray(cv2.LUT(frame, np.clip(np.rint(table), 0, 255).astype(np.uint8)[None]))


@numba.njit(**KERNEL)
def _line(here, there, counts):  # type: ignore[no-untyped-def]
    """Gain and offset that take the levels [n] uint8 of one picture to those [n] of the other.

    Medians are those of how often each level is there: to count takes a fraction of the time of `np.median`. `counts`
    [6, 256] is room for that: of both pictures, and of where the first is bright and where it is not.
    """
    for row in range(6):
        for level in range(256):
            counts[row, level] = 0
    for k in range(len(here)):
        counts[0, here[k]] += 1
        counts[1, there[k]] += 1
    middle, bright, gain = _median(counts[0]), 0, 1.0
    for k in range(len(here)):
        part = 2 if here[k] > middle else 4
        counts[part, here[k]] += 1
        counts[part + 1, there[k]] += 1
        bright += part == 2
    if 0 < bright < len(here):
        apart = _median(counts[2]) - _median(counts[4])
        if apart >= LEAST_CONTRAST:
            gain = min(max((_median(counts[3]) - _median(counts[5])) / apart, GAINS[0]), GAINS[1])
    return gain, _median(counts[1]) - gain * middle


@numba.njit(**KERNEL)
def _median(counts):  # type: ignore[no-untyped-def]
    """Median of the levels that there are `counts` [256] of."""
    total, upto, lower = 0, 0, -1
    for level in range(len(counts)):
        total += counts[level]
    for level in range(len(counts)):
        upto += counts[level]
        if lower < 0 and upto > (total - 1) // 2:
            lower = level
        if upto > total // 2:
            return (lower + level) / 2
    return 0.0


def tolerance(frame: np.ndarray, noise: np.ndarray | float = 0.0) -> np.ndarray:
    """Expected residual [h, w], in colour levels, of the right match of each pixel of a frame [h, w, 3].

    Args:
        noise: [h, w] of `noise_of`, which counts where it is more than that of a good picture.
    """
    return np.asarray(np.maximum(np.float32(TOLERANCE[0]), noise) + _misplaced(frame))


def noise_of(frame: np.ndarray, apart: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Levels [h, w] by which the noise of a frame [h, w, 3] lets right matches differ.

    The median of what flow leaves beyond errors of position, by brightness, on which the noise of a sensor depends: in
    BRIGHTNESSES parts of as many matches each, linear between them.

    Args:
        apart: [n, ...] mean difference of the colours to n frames along the flow, in levels, of [::EVERY_PX,
            ::EVERY_PX] of the pixels. inside: [n, ...] bool, where it leads to.
    """
    grey = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
    if inside.sum() < BRIGHTNESSES:
        return np.zeros(grey.shape, np.float32)
    here, beyond = (of[::EVERY_PX, ::EVERY_PX] for of in (grey, _misplaced(frame)))
    brightness, left = np.broadcast_to(here, apart.shape)[inside], (apart - beyond)[inside]
    parts = np.array_split(np.argsort(brightness, kind="stable"), BRIGHTNESSES)
    at, noise = (np.array([np.median(of[part]) for part in parts]) for of in (brightness, left))
    return np.asarray(np.interp(np.arange(256), at, np.maximum(noise, 0)).astype(np.float32)[grey])


def _misplaced(frame: np.ndarray) -> np.ndarray:
    """Levels [h, w] that an error of position makes of the slopes of a frame [h, w, 3]."""
    grey = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
    slope = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=1 / 8))
    return np.asarray(TOLERANCE[1] * cv2.blur(slope, (SLOPE_PX, SLOPE_PX)))
