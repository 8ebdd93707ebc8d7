"""A textured wall that a camera passes sideways: what `test_swept` and `test_transients` share."""

import cv2
import numpy as np

T = 9
"""Frames of a clip."""
EDGES = np.array([(i, i + gap) for i in range(T) for gap in (-3, -2, -1, 1, 2, 3) if 0 <= i + gap < T])
"""Frames [E, 2] of each edge of its flow."""


def texture(seed: int, size: tuple[int, int]) -> np.ndarray:
    """A picture [h, w, 3] uint8 with detail of several sizes."""
    noise = np.random.default_rng(seed).standard_normal((*size, 3))
    image = sum(cv2.GaussianBlur(noise, (0, 0), sigma) * sigma for sigma in (1.5, 5.0))
    return np.asarray(cv2.normalize(image, None, 40, 215, cv2.NORM_MINMAX).astype(np.uint8))
