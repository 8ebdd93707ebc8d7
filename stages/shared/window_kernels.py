"""Kernels that compare windows of two pictures where a pixel at a static depth is seen."""

import numba
import numpy as np

KERNEL = {"cache": True, "nogil": True, "error_model": "numpy"}
NEAREST = 0.2
"""Least ratio of a depth in another frame and in this one."""


@numba.njit(**KERNEL)
def place(A, b, u, v, depth):  # type: ignore[no-untyped-def]
    """Where pixel u, v at an inverse depth is seen, by A [3, 3] and b [3] of `cameras.projection`; outside of every
    image if it is too near to the other camera."""
    Z = A[2, 0] * u + A[2, 1] * v + A[2, 2] + depth * b[2]
    if Z < NEAREST:
        return -1e9, -1e9
    x = A[0, 0] * u + A[0, 1] * v + A[0, 2] + depth * b[0]
    y = A[1, 0] * u + A[1, 1] * v + A[1, 2] + depth * b[1]
    return x / Z, y / Z


@numba.njit(**KERNEL)
def window_difference(image, expected, u, v, x, y, half, most):  # type: ignore[no-untyped-def]
    """Mean difference in colour levels between the windows around x, y of an image [h, w, 3] uint8 and around u, v of
    the expected [h, w, 3], `half` pixels on either side of their middle; infinite from `most` on."""
    h, w = expected.shape[:2]
    left, top = min(int(x), w - 2), min(int(y), h - 2)
    right_share, low_share = np.float32(x - left), np.float32(y - top)
    rows = range(max(-half, -v, -top), min(half, h - 1 - v, h - 2 - top) + 1)
    columns = range(max(-half, -u, -left), min(half, w - 1 - u, w - 2 - left) + 1)
    total, count = np.float32(0), 3 * len(rows) * len(columns)
    for dv in rows:
        for du in columns:
            row, column = top + dv, left + du
            for c in range(3):
                a, b = np.float32(image[row, column, c]), np.float32(image[row + 1, column, c])
                a += right_share * (np.float32(image[row, column + 1, c]) - a)
                b += right_share * (np.float32(image[row + 1, column + 1, c]) - b)
                total += abs(a + low_share * (b - a) - np.float32(expected[v + dv, u + du, c]))
        if total >= most * count:
            return np.inf
    return total / count
