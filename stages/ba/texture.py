"""Where the pictures, rather than the smoothness of the flow, say how a pixel moves."""

import cv2
import numpy as np

BLUR_PX, WINDOW_PX = 1.0, 9
SMOOTHED = 1.0
"""Squared gradient, (grey levels / px)^2, that counts as much as the smoothness that dense flow assumes.

Smoothness draws flow of little texture towards a constant: it looks less expanded, and the focal length comes out
short. The error is the same in all edges, so that their number does not average it away.
"""
FLOOR = 0.05
"""Without texture anywhere the adjustment still goes by what the flow says."""


def texture_weights(grey: np.ndarray) -> np.ndarray:
    """Share [h, w] float32, FLOOR..1, that a grey frame [h, w] uint8 itself has in the flow at each pixel.

    From the smaller eigenvalue of the structure tensor: along an edge the picture tells no more than on a flat wall.
    """
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), BLUR_PX)
    gx, gy = (cv2.Sobel(smooth, -1, *order, ksize=3, scale=1 / 8) for order in ((1, 0), (0, 1)))
    xx, yy, xy = (cv2.blur(product, (WINDOW_PX, WINDOW_PX)) for product in (gx * gx, gy * gy, gx * gy))
    eigenvalue = np.maximum((xx + yy) / 2 - np.sqrt((xx - yy) ** 2 / 4 + xy**2), 0)
    return np.asarray(np.maximum(eigenvalue / (eigenvalue + SMOOTHED), FLOOR))
