"""How loud the noise of a picture is, and pictures that are smoothed where it is loud."""

import cv2
import numpy as np

MIN_NOISE = 0.29
"""Standard deviation of 8-bit rounding, in grey levels."""
LOUD, BLUR_PX, MOST_PX = 4.0, 0.18, 3.0
"""Standard deviation of the noise, in grey levels, from which on a picture is smoothed, and the standard deviation of
the Gaussian, in pixels per grey level, and at most. Fine texture in daylight looks like noise of 1 to 3.5 levels."""
DARK, BRIGHT = 1, 254
"""Grey levels up to which, and from which on, a picture is saturated: it shows neither noise nor exposure there."""


def noise_variance(image: np.ndarray, seen: np.ndarray | None = None) -> float:
    """Variance of the noise of a grey frame [h, w] uint8 or float32, in squared grey levels.

    Immerkaer, CVIU 1996, with the median in place of the mean: edges affect it less.

    Args:
        seen: [h, w] bool, the pixels that count, some of them; None: all.
    """
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    response = np.abs(cv2.filter2D(image, cv2.CV_32F, kernel))
    response = response if seen is None else response[seen]
    return max(float(np.median(response)) / 0.6745 / 6, MIN_NOISE) ** 2


def blur_of_noise(rgb: np.ndarray) -> float:
    """Standard deviation in pixels of the Gaussian that the noise of a picture [h, w, 3] uint8 calls for; 0: none.

    White noise falls to 0.28 / px of itself, to 1.6 levels where MOST_PX allows. What is saturated has none.
    """
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    seen = (grey > DARK) & (grey < BRIGHT)
    level = float(np.sqrt(noise_variance(grey, seen))) if seen.any() else 0.0
    return min(BLUR_PX * level, MOST_PX) if level > LOUD else 0.0


def smoothed(rgb: np.ndarray, blur_px: float) -> np.ndarray:
    """A picture [h, w, 3] uint8 behind a Gaussian of `blur_of_noise`."""
    return np.asarray(cv2.GaussianBlur(rgb, (0, 0), blur_px)) if blur_px else rgb
