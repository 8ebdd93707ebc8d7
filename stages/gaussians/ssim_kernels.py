"""Numba kernels of the structural similarity (Wang et al. 2004) and its gradient.

The window is an 11 x 11 Gaussian with sigma 1.5 px and zero padding. Images are [H, W, C] float32; blurred
planes are [planes, H, W].
"""

import numpy as np
from numba import njit

from stages.shared.threads import spread

RADIUS = 5
SIGMA_PX = 1.5
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)
STRIP = 16
"""Rows per task of the separable blur."""
FAST = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}


def window() -> np.ndarray:
    """The normalised 1-D Gaussian [11] float32."""
    weights = np.exp(-((np.arange(2 * RADIUS + 1) - RADIUS) ** 2) / (2 * SIGMA_PX**2))
    return (weights / weights.sum()).astype(np.float32)


def blur(planes: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Separable blur of planes [P, H, W] by weights [11], zero padding: vertically into a row, then horizontally."""
    blurred = np.empty_like(planes)
    strips = (planes.shape[1] + STRIP - 1) // STRIP
    spread(_blur, len(planes) * strips, planes, weights, strips, blurred)
    return blurred


@njit(**FAST)
def _blur(first: int, last: int, planes: np.ndarray, w: np.ndarray, strips: int, blurred: np.ndarray) -> None:
    _, H, W = planes.shape
    row = np.zeros(W + 2 * RADIUS, np.float32)
    for task in range(first, last):
        plane, strip = task // strips, task % strips
        for y in range(strip * STRIP, min(H, strip * STRIP + STRIP)):
            row[RADIUS : RADIUS + W] = 0
            for k in range(max(0, RADIUS - y), min(2 * RADIUS + 1, H + RADIUS - y)):
                for x in range(W):
                    row[x + RADIUS] += w[k] * planes[plane, y + k - RADIUS, x]
            for x in range(W):
                blurred[plane, y, x] = (
                    w[0] * row[x] + w[1] * row[x + 1] + w[2] * row[x + 2] + w[3] * row[x + 3] + w[4] * row[x + 4]
                    + w[5] * row[x + 5] + w[6] * row[x + 6] + w[7] * row[x + 7] + w[8] * row[x + 8] + w[9] * row[x + 9]
                    + w[10] * row[x + 10]
                )  # fmt: skip


def products(image: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Planes [3 C, H, W] of image and target [H, W, C]: image, image^2, image x target."""
    H, W, C = image.shape
    planes = np.empty((3 * C, H, W), np.float32)
    spread(_products, H, image, target, planes)
    return planes


@njit(**FAST)
def _products(first: int, last: int, image: np.ndarray, target: np.ndarray, planes: np.ndarray) -> None:
    _, W, C = image.shape
    for y in range(first, last):
        for c in range(C):
            for x in range(W):
                a = image[y, x, c]
                planes[c, y, x] = a
                planes[C + c, y, x] = a * a
                planes[2 * C + c, y, x] = a * target[y, x, c]


def similarity(moments: np.ndarray, target_moments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum of SSIM per row [H] float64, and its derivative by the image's moments [3 C, H, W].

    Args:
        moments: blurred `products`. target_moments: [2 C, H, W], blurred target and target^2.

    SSIM = a b / (d e) with a = 2 mx my + C1, b = 2 sxy + C2, d = mx^2 + my^2 + C1, e = sxx + syy + C2.
    """
    sums, derivative = np.zeros(moments.shape[1]), np.empty_like(moments)
    spread(_similarity, len(sums), moments, target_moments, sums, derivative)
    return sums, derivative


@njit(**FAST)
def _similarity(
    first: int, last: int, moments: np.ndarray, target_moments: np.ndarray, sums: np.ndarray, derivative: np.ndarray
) -> None:
    C, W = len(moments) // 3, moments.shape[2]
    for y in range(first, last):
        for c in range(C):
            total = 0.0
            for x in range(W):
                mx, my = moments[c, y, x], target_moments[c, y, x]
                a = 2 * mx * my + C1
                b = 2 * (moments[2 * C + c, y, x] - mx * my) + C2
                d = mx * mx + my * my + C1
                e = moments[C + c, y, x] - mx * mx + target_moments[C + c, y, x] - my * my + C2
                inverse = 1 / (d * e)
                value = a * b * inverse
                total += value
                by_xy, by_xx = 2 * a * inverse, -value / e
                derivative[2 * C + c, y, x] = by_xy
                derivative[C + c, y, x] = by_xx
                derivative[c, y, x] = 2 * my * b * inverse - 2 * mx * value / d - my * by_xy - 2 * mx * by_xx
            sums[y] += total


def assemble(image: np.ndarray, target: np.ndarray, blurred: np.ndarray, scale: float) -> np.ndarray:
    """Gradient [H, W, C] of scale x sum of SSIM by the image.

    Args:
        image, target: [H, W, C].
        blurred: [3 C, H, W], the derivative by the moments, blurred: a symmetric blur is its own adjoint.
    """
    gradient = np.empty_like(image)
    spread(_assemble, len(image), image, target, blurred, np.float32(scale), gradient)
    return gradient


@njit(**FAST)
def _assemble(
    first: int,
    last: int,
    image: np.ndarray,
    target: np.ndarray,
    blurred: np.ndarray,
    factor: np.float32,
    gradient: np.ndarray,
) -> None:
    _, W, C = image.shape
    for y in range(first, last):
        for c in range(C):
            for x in range(W):
                by_square = 2 * image[y, x, c] * blurred[C + c, y, x]
                by_product = target[y, x, c] * blurred[2 * C + c, y, x]
                gradient[y, x, c] = factor * (blurred[c, y, x] + by_square + by_product)
