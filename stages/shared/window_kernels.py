"""Kernels that compare windows of two pictures where a pixel at a static depth is seen.

They take what belongs to all pictures, and the index j of one: numba counts references of each part that is handed on,
which takes as long as the comparison.
"""

import numba
import numpy as np

KERNEL = {"cache": True, "nogil": True, "error_model": "numpy"}
NEAREST = 0.2
"""Least ratio of a depth in another frame and in this one."""


@numba.njit(**KERNEL)
def place(A, b, j, u, v, depth):  # type: ignore[no-untyped-def]
    """Where pixel u, v at an inverse depth is seen, by A [F, 3, 3] and b [F, 3] of `cameras.projection`; outside of
    every image if it is too near to the other camera."""
    Z = A[j, 2, 0] * u + A[j, 2, 1] * v + A[j, 2, 2] + depth * b[j, 2]
    if Z < NEAREST:
        return -1e9, -1e9
    x = A[j, 0, 0] * u + A[j, 0, 1] * v + A[j, 0, 2] + depth * b[j, 0]
    y = A[j, 1, 0] * u + A[j, 1, 1] * v + A[j, 1, 2] + depth * b[j, 1]
    return x / Z, y / Z


@numba.njit(**KERNEL)
def window_difference(images, expected, j, u, v, x, y, half, most):  # type: ignore[no-untyped-def]
    """Mean difference in colour levels between the windows around x, y of images [F, h, w, 3] uint8 and around u, v of
    the expected [F, h, w, 3], `half` pixels on either side of their middle; infinite from `most` on."""
    h, w = expected.shape[1:3]
    left, top = min(int(x), w - 2), min(int(y), h - 2)
    right_share, low_share = np.float32(x - left), np.float32(y - top)
    rows = range(max(-half, -v, -top), min(half, h - 1 - v, h - 2 - top) + 1)
    columns = range(max(-half, -u, -left), min(half, w - 1 - u, w - 2 - left) + 1)
    total, count = np.float32(0), 3 * len(rows) * len(columns)
    for dv in rows:
        for du in columns:
            row, column = top + dv, left + du
            for c in range(3):
                a, b = np.float32(images[j, row, column, c]), np.float32(images[j, row + 1, column, c])
                a += right_share * (np.float32(images[j, row, column + 1, c]) - a)
                b += right_share * (np.float32(images[j, row + 1, column + 1, c]) - b)
                total += abs(a + low_share * (b - a) - np.float32(expected[j, v + dv, u + du, c]))
        if total >= most * count:
            return np.inf
    return total / count
