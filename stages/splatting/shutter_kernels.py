"""Numba kernels of the mean radiance of several pictures: `shutter.to_linear` and `to_display` on vectors of pixels.

A power is taken of a number between 1/2 and 1, by a polynomial; powers of two bring all others there.
"""

from typing import Any

import numpy as np
from numba import njit

from stages.shared.lanes import LANES, load, store, where
from stages.shared.threads import spread

FAST = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}
LARGEST = 2.0**23
"""Larger numbers have the power of this one: the radiance of a display colour of 800."""
DOUBLINGS = (16, 8, 4, 2, 1)
"""Some of them bring any number from LARGEST / 2^32 on, far below KNEE, above a half of LARGEST."""
KNEE, SLOPE, SCALE, POWER = 0.0031308, 12.92, 1.055, 2.4
"""The curve of sRGB (IEC 61966-2-1): linear up to KNEE, then a power. Its slope is finite everywhere."""
DARK, OFFSET = SLOPE * KNEE, SCALE - 1
NOTHING = np.zeros(LANES, np.float32)


def _fitted(exponent: float) -> tuple[float, ...]:
    """Coefficients of a polynomial for m^exponent, m in 1/2..1, to the last digits of float32."""
    fit = np.polynomial.Chebyshev.interpolate(lambda m: m**exponent, 7, domain=[0.5, 1])
    return tuple(fit.convert(kind=np.polynomial.Polynomial).coef.tolist())


def _factors(exponent: float) -> tuple[float, ...]:
    """What each of DOUBLINGS, and last LARGEST, makes of a power."""
    return (*(0.5 ** (exponent * count) for count in DOUBLINGS), LARGEST**exponent)


TO_LINEAR, LINEAR_FACTORS = _fitted(POWER), _factors(POWER)
TO_DISPLAY, DISPLAY_FACTORS = _fitted(1 / POWER), _factors(1 / POWER)
LIMITS = tuple(0.5**count for count in DOUBLINGS)


@njit(inline="always", **FAST)
def _power(x: Any, p: tuple[float, ...], factors: tuple[float, ...]) -> Any:
    """x^e of a vector within LARGEST / 2^32..LARGEST, from `_fitted` and `_factors` of e."""
    m = where(x < LARGEST, x, LARGEST) / LARGEST
    factor = load(NOTHING, 0) + factors[-1]
    for k in range(len(LIMITS)):
        small = m < LIMITS[k]
        m, factor = where(small, m / LIMITS[k], m), where(small, factor * factors[k], factor)
    return factor * (p[0] + m * (p[1] + m * (p[2] + m * (p[3] + m * (p[4] + m * (p[5] + m * (p[6] + m * p[7])))))))


@njit(inline="always", **FAST)
def _bright(colour: Any) -> Any:
    """`shutter.to_linear` of a colour above DARK."""
    return _power((where(colour > DARK, colour, DARK) + OFFSET) / SCALE, TO_LINEAR, LINEAR_FACTORS)


def average(colours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Display colours [n] of the mean radiance of colours [S, n] float32, n a multiple of LANES, and that radiance."""
    shown, radiance = np.empty_like(colours[0]), np.empty_like(colours[0])
    spread(_average, len(shown) // LANES, colours, 1 / len(colours), shown, radiance)
    return shown, radiance


@njit(**FAST)
def _average(first: int, last: int, colours: np.ndarray, share: float, shown: np.ndarray,
             radiance: np.ndarray) -> None:  # fmt: skip
    S, n = colours.shape
    for at in range(LANES * first, LANES * last, LANES):
        summed = load(NOTHING, 0)
        for s in range(S):
            colour = load(colours, s * n + at)
            summed = summed + where(colour > DARK, _bright(colour), colour / SLOPE)
        mean = summed * share
        curve = _power(where(mean > KNEE, mean, KNEE), TO_DISPLAY, DISPLAY_FACTORS) * SCALE - OFFSET
        store(radiance, at, mean)
        store(shown, at, where(mean > KNEE, curve, mean * SLOPE))


def average_adjoint(colour: np.ndarray, shown: np.ndarray, radiance: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Gradient [n] of one of the pictures, of colours [n], from that of `shown`, g [n] times the picture's share."""
    gradient = np.empty_like(colour)
    spread(_average_adjoint, len(colour) // LANES, colour, shown, radiance, g, gradient)
    return gradient


@njit(**FAST)
def _average_adjoint(first: int, last: int, colour: np.ndarray, shown: np.ndarray, radiance: np.ndarray,
                     g: np.ndarray, gradient: np.ndarray) -> None:  # fmt: skip
    for at in range(LANES * first, LANES * last, LANES):
        c, r = load(colour, at), load(radiance, at)
        display_slope = where(r > KNEE, (load(shown, at) + OFFSET) / (where(r > KNEE, r, KNEE) * POWER), SLOPE)
        linear_slope = where(c > DARK, _bright(c) * POWER / (where(c > DARK, c, DARK) + OFFSET), 1 / SLOPE)
        store(gradient, at, load(g, at) * display_slope * linear_slope)
