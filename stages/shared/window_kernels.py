"""Kernels that compare windows of two pictures where a pixel at a static depth is seen.

They take what belongs to all pictures, and the index j of one: numba counts references of each part that is handed on,
which takes as long as the comparison.
"""

import numba
import numpy as np

KERNEL = {"cache": True, "nogil": True, "error_model": "numpy"}
NEAREST = 0.2
"""Least ratio of a depth in another frame and in this one."""


def of_rows(A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A [F, R, 3, 3] and b [F, R, 3] as `place` takes them: of every row (`rolling`), or of all as one, [F, 3, 3]."""
    return A.reshape(len(A), -1, 3, 3), b.reshape(len(b), -1, 3)


@numba.njit(**KERNEL)
def place(A, b, j, u, v, depth):  # type: ignore[no-untyped-def]
    """Where pixel u, v at an inverse depth is seen, by A [F, R, 3, 3] and b [F, R, 3] of `cameras.projection`, of every
    row or of all as one; outside of every image if it is too near to the other camera."""
    row = min(v, A.shape[1] - 1)
    Z = A[j, row, 2, 0] * u + A[j, row, 2, 1] * v + A[j, row, 2, 2] + depth * b[j, row, 2]
    if Z < NEAREST:
        return -1e9, -1e9
    x = A[j, row, 0, 0] * u + A[j, row, 0, 1] * v + A[j, row, 0, 2] + depth * b[j, row, 0]
    y = A[j, row, 1, 0] * u + A[j, row, 1, 1] * v + A[j, row, 1, 2] + depth * b[j, row, 1]
    return x / Z, y / Z


@numba.njit(**KERNEL | {"fastmath": {"reassoc", "nsz", "contract"}})
def window_difference(images, expected, size, j, u, v, x, y, half, most):  # type: ignore[no-untyped-def]
    """Mean difference in colour levels between the windows around x, y of images and around u, v of the expected, both
    [F, h, w, 3] uint8 as one row, of `size` (h, w), `half` pixels on either side of their middle; infinite from `most`
    on.

    The colours of a row of the window lie side by side. Unsigned indices need no check for negative ones, which count
    from the end: without it the loop over a row becomes vector instructions, and takes .4 of the time. They sum in an
    order of their own: between processors the last bits may differ.
    """
    h, w = size
    left, top = min(int(x), w - 2), min(int(y), h - 2)
    right_share, low_share = np.float32(x - left), np.float32(y - top)
    first, last = max(-half, -v, -top), min(half, h - 1 - v, h - 2 - top)
    begin, end = max(-half, -u, -left), min(half, w - 1 - u, w - 2 - left)
    at, here = 3 * ((j * h + top + first) * w + left + begin), 3 * ((j * h + v + first) * w + u + begin)
    row, values = 3 * w, 3 * (end - begin + 1)
    total, count = np.float32(0), values * (last - first + 1)
    for _ in range(first, last + 1):
        for k in range(values):
            a, b = np.float32(images[np.uint64(at + k)]), np.float32(images[np.uint64(at + row + k)])
            a += right_share * (np.float32(images[np.uint64(at + k + 3)]) - a)
            b += right_share * (np.float32(images[np.uint64(at + row + k + 3)]) - b)
            total += abs(a + low_share * (b - a) - np.float32(expected[np.uint64(here + k)]))
        if total >= most * count:
            return np.inf
        at, here = at + row, here + row
    return total / count
