"""Subtraction of the background: how a frame differs from what the frames around agree on.

At the depth of the static scene the frames in which no mover covers a place show the same there. A part of a mover
whose own motion is not known, as a rope or an arm, stands out from it, and so does its shadow.
"""

import cv2
import numba
import numpy as np

from stages.segment.uncovered import Around, is_uncovered
from stages.shared.window_kernels import KERNEL, place

WINDOW_PX = 3
"""Over which pictures are averaged first: noise, and errors of position, would look like what stands out."""
LEAST_FRAMES = 3
"""Frames that must show a place uncovered."""


def against_background(depth: np.ndarray, asked: np.ndarray, around: Around) -> tuple[np.ndarray, np.ndarray]:
    """How far a frame lies from what the frames around agree on, and these from one another, both [h, w], in levels.

    Means over the colours of the mean and of the standard deviation of their differences to the frame. Both are 0 where
    nothing is asked, and where fewer than LEAST_FRAMES show the place uncovered.

    Args:
        depth: [h, w] static inverse depth of the frame. asked: [h, w] bool.
    """
    apart, spread = np.zeros((2, *depth.shape), np.float32)
    if not asked.any():
        return apart, spread
    pictures, expected = (np.stack([cv2.blur(of, (WINDOW_PX,) * 2) for of in some]) for some in around[:2])
    _against_background(pictures, expected, *around[2:], depth, asked, np.empty((2, 3)), apart, spread)
    return apart, spread


@numba.njit(**KERNEL)
def _against_background(pictures, expected, covered, A, b, depth, asked, sums, apart, spread):  # type: ignore[no-untyped-def]
    """Write `apart` and `spread` [h, w]; `sums` [2, 3] are room for those of the differences and of their squares."""
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            if not asked[v, u]:
                continue
            shown = 0
            for c in range(3):
                sums[0, c] = sums[1, c] = 0
            for j in range(len(covered)):
                x, y = place(A, b, j, u, v, depth[v, u])
                if is_uncovered(covered, j, x, y):
                    shown += 1
                    _add(pictures, expected, j, u, v, x, y, sums)
            if shown < LEAST_FRAMES:
                continue
            for c in range(3):
                mean = sums[0, c] / shown
                apart[v, u] += abs(mean) / 3
                spread[v, u] += np.sqrt(max(sums[1, c] / shown - mean**2, 0.0)) / 3


@numba.njit(**KERNEL)
def _add(pictures, expected, j, u, v, x, y, sums):  # type: ignore[no-untyped-def]
    """Add the differences, and their squares, of picture j of [F, h, w, 3] at x, y to the expected one at u, v."""
    h, w = pictures.shape[1:3]
    left, top = int(x), int(y)
    right, low, dx, dy = min(left + 1, w - 1), min(top + 1, h - 1), x - left, y - top
    for c in range(3):
        above = pictures[j, top, left, c] * (1 - dx) + pictures[j, top, right, c] * dx
        below = pictures[j, low, left, c] * (1 - dx) + pictures[j, low, right, c] * dx
        difference = above * (1 - dy) + below * dy - expected[j, v, u, c]
        sums[0, c] += difference
        sums[1, c] += difference**2
