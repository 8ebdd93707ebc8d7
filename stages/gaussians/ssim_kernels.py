"""Numba kernels of the structural similarity (Wang et al. 2004) and of absolute differences, and their gradient.

The window is an 11 x 11 Gaussian with sigma 1.5 px and zero padding. Images are [H, W, C] float32. Planes are
[planes, H, S], S = W rounded up to whole vectors; columns from W on are zero, as the padding is.
"""

import numpy as np
from numba import njit

from stages.shared.lanes import LANES, load, store
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
    """Separable blur of planes [P, H, S] by weights [11], zero padding: vertically into a row, then horizontally.

    What the blur writes to columns from W on is not zero; none of it is read as a column of the image.
    """
    blurred = np.empty_like(planes)
    strips = (planes.shape[1] + STRIP - 1) // STRIP
    spread(_blur, len(planes) * strips, planes, weights, strips, blurred)
    return blurred


@njit(**FAST)
def _blur(first: int, last: int, planes: np.ndarray, w: np.ndarray, strips: int, blurred: np.ndarray) -> None:
    _, H, S = planes.shape
    row, nothing = np.zeros(S + 2 * RADIUS, np.float32), np.zeros(LANES, np.float32)
    for task in range(first, last):
        plane, strip = task // strips, task % strips
        for y in range(strip * STRIP, min(H, strip * STRIP + STRIP)):
            for x in range(0, S, LANES):
                summed, at = load(nothing, 0), (plane * H + y - RADIUS) * S + x
                for k in range(max(0, RADIUS - y), min(2 * RADIUS + 1, H + RADIUS - y)):
                    summed = summed + load(planes, at + k * S) * w[k]
                store(row, x + RADIUS, summed)
            for x in range(0, S, LANES):
                summed = load(nothing, 0)
                for k in range(2 * RADIUS + 1):
                    summed = summed + load(row, x + k) * w[k]
                store(blurred, (plane * H + y) * S + x, summed)


def squares(image: np.ndarray) -> np.ndarray:
    """Planes [2 C, H, S] of an image [H, W, C]: the image, and its square."""
    H, W, C = image.shape
    planes = np.zeros((2 * C, H, (W + LANES - 1) // LANES * LANES), np.float32)
    planes[:C, :, :W] = np.moveaxis(image, -1, 0)
    planes[C:] = planes[:C] * planes[:C]
    return planes


def products(image: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Planes [3 C, H, S] of image and target [H, W, C]: image, image^2, image x target.

    Also the sums [H, 2] float64 of the absolute and of the squared differences in each row.
    """
    H, W, C = image.shape
    planes = np.empty((3 * C, H, (W + LANES - 1) // LANES * LANES), np.float32)
    sums = np.zeros((H, 2))
    spread(_products, H, image, target, planes, sums)
    return planes, sums


@njit(**FAST)
def _products(first: int, last: int, image: np.ndarray, target: np.ndarray, planes: np.ndarray,
              sums: np.ndarray) -> None:  # fmt: skip
    _, W, C = image.shape
    for y in range(first, last):
        for c in range(C):
            absolute, squared = 0.0, 0.0
            for x in range(W):
                a, b = image[y, x, c], target[y, x, c]
                planes[c, y, x] = a
                planes[C + c, y, x] = a * a
                planes[2 * C + c, y, x] = a * b
                absolute += abs(a - b)
                squared += (a - b) * (a - b)
            sums[y, 0] += absolute
            sums[y, 1] += squared
            for plane in range(c, 3 * C, C):
                for x in range(W, planes.shape[2]):
                    planes[plane, y, x] = 0


def similarity(moments: np.ndarray, target_moments: np.ndarray, W: int) -> tuple[np.ndarray, np.ndarray]:
    """Sum of SSIM per row [H] float64, and its derivative by the image's moments [3 C, H, S].

    Args:
        moments: blurred `products`. target_moments: [2 C, H, S], blurred `squares`. W: width of the image.

    SSIM = a b / (d e) with a = 2 mx my + C1, b = 2 sxy + C2, d = mx^2 + my^2 + C1, e = sxx + syy + C2.
    """
    sums, derivative = np.zeros(moments.shape[1]), np.empty_like(moments)
    spread(_similarity, len(sums), moments, target_moments, W, sums, derivative)
    return sums, derivative


@njit(**FAST)
def _similarity(
    first: int,
    last: int,
    moments: np.ndarray,
    target_moments: np.ndarray,
    W: int,
    sums: np.ndarray,
    derivative: np.ndarray,
) -> None:
    C = len(moments) // 3
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
            for plane in range(c, 3 * C, C):
                for x in range(W, moments.shape[2]):
                    derivative[plane, y, x] = 0


def assemble(
    image: np.ndarray, target: np.ndarray, blurred: np.ndarray, by_ssim: float, by_difference: float
) -> np.ndarray:
    """Gradient [H, W, C] of by_ssim x sum of SSIM + by_difference x sum of absolute differences, by the image.

    Args:
        image, target: [H, W, C].
        blurred: [3 C, H, S], the derivative by the moments, blurred: a symmetric blur is its own adjoint.
    """
    gradient = np.empty_like(image)
    factors = np.float32(by_ssim), np.float32(by_difference)
    spread(_assemble, len(image), image, target, blurred, *factors, gradient)
    return gradient


@njit(**FAST)
def _assemble(
    first: int,
    last: int,
    image: np.ndarray,
    target: np.ndarray,
    blurred: np.ndarray,
    by_ssim: np.float32,
    by_difference: np.float32,
    gradient: np.ndarray,
) -> None:
    _, W, C = image.shape
    for y in range(first, last):
        for c in range(C):
            for x in range(W):
                by_square = 2 * image[y, x, c] * blurred[C + c, y, x]
                by_product = target[y, x, c] * blurred[2 * C + c, y, x]
                side = by_difference * np.sign(image[y, x, c] - target[y, x, c])
                gradient[y, x, c] = by_ssim * (blurred[c, y, x] + by_square + by_product) + side
