"""Texture weights: the share of the image, against that of the smoothness term, in the flow of a pixel."""

import cv2
import numpy as np

BLUR_PX, WINDOW_PX = 1.0, 9
SMOOTHED = 1.0
"""Squared gradient, (grey levels / px)^2, at which image and smoothness term weigh the same.

Smoothness pulls flow of little texture towards a constant: the flow expands less, and the estimated focal length is
too short. The error is the same in all edges, so averaging over them does not reduce it.
"""
FLOOR = 0.05
"""Smallest weight: without texture anywhere, the adjustment still uses the flow."""


def texture_weights(grey: np.ndarray) -> np.ndarray:
    """Texture weight [h, w] float32, FLOOR..1, of each pixel of a grey frame [h, w] uint8.

    From the smaller eigenvalue of the structure tensor: motion along an edge is as undetermined as on a flat wall.
    """
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), BLUR_PX)
    gx, gy = (cv2.Sobel(smooth, -1, *order, ksize=3, scale=1 / 8) for order in ((1, 0), (0, 1)))
    xx, yy, xy = (cv2.blur(product, (WINDOW_PX, WINDOW_PX)) for product in (gx * gx, gy * gy, gx * gy))
    eigenvalue = np.maximum((xx + yy) / 2 - np.sqrt((xx - yy) ** 2 / 4 + xy**2), 0)
    return np.asarray(np.maximum(eigenvalue / (eigenvalue + SMOOTHED), FLOOR))
