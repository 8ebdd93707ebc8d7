"""What is known of some pixels, extended to those around.

Channel by channel: over the two channels of flow, NumPy's own broadcast takes three times as long.
"""

import cv2
import numpy as np


def weigh(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Values [h, w, c] times their weight [h, w], and behind them the weight: [h, w, c + 1]."""
    weighted = np.empty((*weight.shape, values.shape[2] + 1), np.result_type(values, weight))
    for c in range(values.shape[2]):
        np.multiply(values[..., c], weight, out=weighted[..., c])
    weighted[..., -1] = weight
    return weighted


def extend(weighted: np.ndarray, sigma_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean [h, w, c] of `weighted` values [h, w, c + 1] over a Gaussian around each pixel, and the weight [h, w] there.

    A normalised convolution (Knutsson and Westin, CVPR 1993), on as coarse a grid as the Gaussian allows.
    """
    h, w = weighted.shape[:2]
    step = max(1, int(sigma_px / 2))
    coarse = cv2.resize(weighted, (max(1, w // step), max(1, h // step)), interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(coarse, (0, 0), sigma_px / step, borderType=cv2.BORDER_CONSTANT)
    blurred = cv2.resize(blurred, (w, h), interpolation=cv2.INTER_LINEAR)
    weight, means = np.maximum(blurred[..., -1], 1e-6), np.empty_like(blurred[..., :-1])
    for c in range(means.shape[2]):
        np.divide(blurred[..., c], weight, out=means[..., c])
    return means, blurred[..., -1]
