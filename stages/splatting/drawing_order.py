"""The order in which Gaussians are drawn, by a radix sort of their depths."""

import numpy as np
from numba import njit

DIGIT = 11
"""Bits that one pass sorts by: its counts fit the first-level cache, and three passes take all 32."""


def drawing_order(depths: np.ndarray) -> np.ndarray:
    """Indices [V] int32 of the Gaussians with depth [N] float32 > 0, nearest first, equal depths by index.

    The bits of positive floats have the order of the floats, and each pass keeps what is equal in order.
    """
    bits = np.ascontiguousarray(depths, np.float32).view(np.uint32)
    indices, other = (np.empty(len(bits), np.int32) for _ in range(2))
    return indices[: _sort(bits, np.zeros((3, 1 << DIGIT), np.int32), indices, other)]


@njit(cache=True, nogil=True)
def _sort(bits: np.ndarray, starts: np.ndarray, indices: np.ndarray, other: np.ndarray) -> int:
    """Fill the first V of `indices` [N], sorted by `bits` [N] where these are of positive floats; returns V.

    `starts` [3, 1 << DIGIT] are zeros, `other` [N] is written over.
    """
    last, V = (1 << DIGIT) - 1, 0
    for i in range(len(bits)):
        if np.int32(bits[i]) > 0:
            other[V] = i
            V += 1
            for digit in range(3):
                starts[digit, (bits[i] >> (DIGIT * digit)) & last] += 1
    for digit in range(3):
        before = 0
        for value in range(last + 1):
            before, starts[digit, value] = before + starts[digit, value], before
    for digit in range(3):
        source, target = (other, indices) if digit % 2 == 0 else (indices, other)
        for k in range(V):
            i = source[k]
            value = (bits[i] >> (DIGIT * digit)) & last
            target[starts[digit, value]] = i
            starts[digit, value] += 1
    return V
