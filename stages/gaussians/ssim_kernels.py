"""Numba kernels of the structural similarity (Wang et al. 2004) and of absolute differences, and their gradient.

The window is an 11 x 11 Gaussian with sigma 1.5 px and zero padding. Images are [H, W, C] float32. Planes are
[planes, H, S], S = W rounded up to whole vectors; before a blur their columns from W on are zero, as the padding is.

The comparison passes down a strip of one channel row by row. Between its two blurs it keeps as many rows as the window
is high, in rings: planes of whole images would leave the cache before they are read again.
"""

from typing import Any

import numpy as np
from numba import njit

from stages.shared.lanes import LANES, load, store, total, where
from stages.shared.threads import spread

RADIUS = 5
SIGMA_PX = 1.5
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)
SIZE = 2 * RADIUS + 1
STRIP = 64
"""Rows per task. Its comparison multiplies 20 rows more; fewer strips than threads would leave some of these idle."""
NOTHING, COLUMNS = np.zeros(LANES, np.float32), np.arange(LANES, dtype=np.float32)
ZERO, ONE, TWO = np.float32(0), np.float32(1), np.float32(2)
FAST = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}


def _window() -> np.ndarray:
    weights = np.exp(-((np.arange(SIZE) - RADIUS) ** 2) / (2 * SIGMA_PX**2))
    return (weights / weights.sum()).astype(np.float32)


WINDOW = _window()
"""The normalised 1-D Gaussian [11] float32."""


def blur(planes: np.ndarray) -> np.ndarray:
    """Separable blur of planes [P, H, S] by the window, zero padding: vertically into a row, then horizontally.

    What the blur writes to columns from W on is not zero; none of it is read as a column of the image.
    """
    blurred = np.empty_like(planes)
    strips = (planes.shape[1] + STRIP - 1) // STRIP
    spread(_blur, len(planes) * strips, planes, WINDOW, strips, blurred)
    return blurred


@njit(**FAST)
def _blur(first: int, last: int, planes: np.ndarray, w: np.ndarray, strips: int, blurred: np.ndarray) -> None:
    _, H, S = planes.shape
    row = np.zeros(S + 2 * RADIUS, np.float32)
    inside, places = np.empty(SIZE, np.float32), np.empty(SIZE, np.int64)
    for task in range(first, last):
        plane, strip = task // strips, task % strips
        for y in range(strip * STRIP, min(H, strip * STRIP + STRIP)):
            at = plane * H * S
            _blur_row(planes, at, H, y, H, w, row, inside, places, blurred, at + y * S)


@njit(inline="always", **FAST)
def _blur_row(source: np.ndarray, start: int, ring: int, y: int, H: int, w: np.ndarray, row: np.ndarray,
              inside: np.ndarray, places: np.ndarray, blurred: np.ndarray, target: int) -> None:  # fmt: skip
    """Blur row y of a plane of H rows into the entries of `blurred` from `target` on.

    Args:
        source: the plane from `start` on, of whose rows the last `ring` are kept, row r in place r % ring; those up to
            RADIUS from y must be among them.
        row: [S + 10] to work in, with zeros at both ends.
    """
    S = len(row) - 2 * RADIUS
    for k in range(SIZE):
        r = y + k - RADIUS
        inside[k] = w[k] if 0 <= r < H else np.float32(0)
        places[k] = start + min(max(r, 0), H - 1) % ring * S  # beyond the plane a row that is kept, hence finite
    for x in range(0, S, LANES):
        summed = load(NOTHING, 0)
        for k in range(SIZE):
            summed = summed + load(source, places[k] + x) * inside[k]
        store(row, x + RADIUS, summed)
    for x in range(0, S, LANES):
        summed = load(NOTHING, 0)
        for k in range(SIZE):
            summed = summed + load(row, x + k) * w[k]
        store(blurred, target + x, summed)


def squares(image: np.ndarray) -> np.ndarray:
    """Planes [2 C, H, S] of an image [H, W, C]: the image, and its square."""
    H, W, C = image.shape
    planes = np.zeros((2 * C, H, (W + LANES - 1) // LANES * LANES), np.float32)
    planes[:C, :, :W] = np.moveaxis(image, -1, 0)
    planes[C:] = planes[:C] * planes[:C]
    return planes


def compare(
    image: np.ndarray, target: np.ndarray, target_moments: np.ndarray, by_ssim: float, by_difference: float
) -> tuple[np.ndarray, np.ndarray]:
    """Sums [3] of SSIM, absolute and squared differences of images [H, W, C], and the gradient [H, W, C] of a loss.

    The loss is by_ssim x sum of SSIM + by_difference x sum of absolute differences, its gradient that by `image`.

    Args:
        target_moments: [2 C, H, S], blurred `squares` of the target.

    SSIM = a b / (d e) with a = 2 mx my + C1, b = 2 sxy + C2, d = mx^2 + my^2 + C1, e = sxx + syy + C2.
    """
    H, _, C = image.shape
    strips = (H + STRIP - 1) // STRIP
    sums, gradient = np.zeros((C * strips, 3)), np.empty_like(image)
    factors = np.float32(by_ssim), np.float32(by_difference)
    spread(_compare, C * strips, image, target, target_moments, WINDOW, strips, *factors, sums, gradient)
    return sums.sum(axis=0), gradient


@njit(**FAST)
def _compare(first: int, last: int, image: np.ndarray, target: np.ndarray, target_moments: np.ndarray, w: np.ndarray,
             strips: int, by_ssim: np.float32, by_difference: np.float32, sums: np.ndarray,
             gradient: np.ndarray) -> None:  # fmt: skip
    """Compare strips of channels: products of row y, moments of the row RADIUS above, gradient of one as far again."""
    H, S = image.shape[0], target_moments.shape[2]
    row, rows = np.zeros(S + 2 * RADIUS, np.float32), np.empty((3, S), np.float32)
    inside, places = np.empty(SIZE, np.float32), np.empty(SIZE, np.int64)
    products, derivative = np.zeros((4, SIZE, S), np.float32), np.empty((3, SIZE, S), np.float32)
    for task in range(first, last):
        c, top = task // strips, task % strips * STRIP
        bottom = min(H, top + STRIP)
        for y in range(max(0, top - 2 * RADIUS), bottom + 2 * RADIUS):
            if y < H:
                _multiply(image, target, c, y, products)
            middle, above = y - RADIUS, y - 2 * RADIUS
            if max(0, top - RADIUS) <= middle < min(H, bottom + RADIUS):
                for plane in range(3):
                    _blur_row(products, plane * SIZE * S, SIZE, middle, H, w, row, inside, places, rows, plane * S)
                similar = _similarity(rows, target_moments, c, middle, image.shape[1], derivative)
                sums[task, 0] += similar if top <= middle < bottom else 0.0
            if top <= above:
                for plane in range(3):
                    _blur_row(derivative, plane * SIZE * S, SIZE, above, H, w, row, inside, places, rows, plane * S)
                absolute, squared = _assemble(products, above % SIZE * S, rows, by_ssim, by_difference)
                sums[task, 1] += absolute
                sums[task, 2] += squared
                for x in range(image.shape[1]):
                    gradient[above, x, c] = rows[0, x]


@njit(inline="always", **FAST)
def _multiply(image: np.ndarray, target: np.ndarray, c: int, y: int, products: np.ndarray) -> None:
    """Row y of image, image^2, image x target and target in channel c."""
    at = y % SIZE
    for x in range(image.shape[1]):
        a, b = image[y, x, c], target[y, x, c]
        products[0, at, x], products[1, at, x], products[2, at, x], products[3, at, x] = a, a * a, a * b, b


@njit(inline="always", **FAST)
def _similarity(rows: np.ndarray, target_moments: np.ndarray, c: int, y: int, W: int, derivative: np.ndarray) -> Any:
    """Sum of SSIM over row y, from its moments [3, S], and its derivative by them, zero from column W on."""
    (planes, H, S), similar, plane = target_moments.shape, load(NOTHING, 0), SIZE * rows.shape[1]
    for x in range(0, S, LANES):
        at = (c * H + y) * S + x
        mx, my = load(rows, x), load(target_moments, at)
        sxx, syy = load(rows, S + x) - mx * mx, load(target_moments, planes // 2 * H * S + at) - my * my
        a, b = mx * my * TWO + C1, (load(rows, 2 * S + x) - mx * my) * TWO + C2
        d, e = mx * mx + my * my + C1, sxx + syy + C2
        inverse = ONE / (d * e)
        value = a * b * inverse
        by_xy, by_xx = a * inverse * TWO, ZERO - value / e
        by_x = my * b * inverse * TWO - mx * value / d * TWO - my * by_xy - mx * by_xx * TWO
        seen, at = load(COLUMNS, 0) < np.float32(W - x), y % SIZE * S + x
        similar = similar + where(seen, value, ZERO)
        store(derivative, at, where(seen, by_x, ZERO))
        store(derivative, plane + at, where(seen, by_xx, ZERO))
        store(derivative, 2 * plane + at, where(seen, by_xy, ZERO))
    return total(similar)


@njit(inline="always", **FAST)
def _assemble(products: np.ndarray, start: int, rows: np.ndarray, by_ssim: np.float32,
              by_difference: np.float32) -> tuple[Any, Any]:  # fmt: skip
    """Put a row of the gradient into `rows[0]`; returns the sums of its absolute and squared differences.

    Args:
        start: of the row in each plane of `products`, which are zero beyond the image.
        rows: [3, S], the derivative by the moments, blurred: a symmetric blur is its own adjoint.
    """
    S = rows.shape[1]
    absolute, squared = load(NOTHING, 0), load(NOTHING, 0)
    for x in range(0, S, LANES):
        a, b = load(products, start + x), load(products, 3 * SIZE * S + start + x)
        difference = a - b
        absolute = absolute + where(difference < ZERO, ZERO - difference, difference)
        squared = squared + difference * difference
        by_moments = load(rows, x) + a * load(rows, S + x) * TWO + b * load(rows, 2 * S + x)
        side = where(difference > ZERO, by_difference, where(difference < ZERO, load(NOTHING, 0) - by_difference, ZERO))
        store(rows, x, by_moments * by_ssim + side)
    return total(absolute), total(squared)
