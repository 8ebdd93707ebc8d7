"""Numba kernels of gains per channel: torch multiplies rows of three numbers one number at a time, on one core."""

import numpy as np
from numba import njit

from stages.shared.threads import spread

STRICT = {"cache": True, "nogil": True, "error_model": "numpy"}


def lit(colour: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Colours [n, 3] times the gain [3]."""
    product = np.empty_like(colour)
    spread(_lit, len(colour), colour, gain, product)
    return product


@njit(**STRICT)
def _lit(first: int, last: int, colour: np.ndarray, gain: np.ndarray, product: np.ndarray) -> None:
    for n in range(first, last):
        for c in range(3):
            product[n, c] = colour[n, c] * gain[c]


def lit_adjoint(colour: np.ndarray, gain: np.ndarray, g: np.ndarray, chunk: int) -> tuple[np.ndarray, np.ndarray]:
    """Gradients of the colours [n, 3] and of the gain [3] from that of their product [n, 3].

    Args:
        chunk: length of the runs over which the latter is summed, so that it does not depend on the thread count.
    """
    chunks = -(-len(colour) // chunk)
    g_colour, sums = np.empty_like(colour), np.zeros((chunks, 3))
    spread(_lit_adjoint, chunks, colour, gain, g, chunk, g_colour, sums)
    return g_colour, sums.sum(axis=0).astype(gain.dtype)


@njit(**STRICT)
def _lit_adjoint(first: int, last: int, colour: np.ndarray, gain: np.ndarray, g: np.ndarray, chunk: int,
                 g_colour: np.ndarray, sums: np.ndarray) -> None:  # fmt: skip
    for part in range(first, last):
        for n in range(part * chunk, min((part + 1) * chunk, len(colour))):
            for c in range(3):
                g_colour[n, c] = g[n, c] * gain[c]
                sums[part, c] += np.float64(g[n, c]) * colour[n, c]
