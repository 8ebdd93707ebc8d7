"""The static scene where movers cover it for a part of the time, as between the legs of someone who walks.

Pictures of neighbouring frames show a leg there, so that neither a static depth nor any motion matches, and the flow is
dragged along with the leg. What is found of the movers tells in which frames nothing covers the place. If it looks the
same in some of them, it rests: in some, since not all of the movers are found.
"""

from typing import NamedTuple

import numba
import numpy as np

from stages.segment.static_world import StaticWorld
from stages.shared.picture_difference import EVERY_PX, exposed
from stages.shared.static_flow import dense_static_flow
from stages.shared.warp import warp
from stages.shared.window_kernels import KERNEL, of_rows, place, window_difference

DISTANCES = 1, 2, 3, 4, 5, 6, 8, 10, 12
"""Distances in frames, either way, of the pictures that are compared: a step takes about as long."""
LEAST_FRAMES = 2
"""Frames that must show the place uncovered."""
ALIKE = 0.3
"""The quantile of the differences to these frames that counts: of two the smaller, of seven the third."""
HALF_WINDOW = 1
"""Pixels of the compared windows on either side of their middle."""


class Around(NamedTuple):
    """The frames around one, as far as cameras were found.

    Attributes:
        pictures: [F, h, w, 3] uint8. expected: [F, h, w, 3] uint8, the frame itself at the exposure of each.
        covered: [F, h, w] bool, where movers, or what is burnt in, hide what is behind them.
        A, b: [F, R, 3, 3] and [F, R, 3] of `StaticWorld.projection` into them.
    """

    pictures: np.ndarray
    expected: np.ndarray
    covered: np.ndarray
    A: np.ndarray
    b: np.ndarray


def frames_around(
    i: int, depth: np.ndarray, frames: dict[int, np.ndarray], covered: dict[int, np.ndarray], world: StaticWorld
) -> Around | None:
    """The frames at DISTANCES from frame i; None if there are none.

    Args:
        depth: [h, w] static inverse depth of frame i, at which exposures are compared.
        frames: pictures [h, w, 3] uint8 of frames around. covered: [h, w] bool, where they show movers.
    """
    others = [j for o in DISTANCES for j in (i - o, i + o) if j in frames and world.observed(i, j)]
    if not others:
        return None
    A, b = (np.stack(part) for part in zip(*(world.projection(i, j) for j in others), strict=True))
    ways = (dense_static_flow(*of, depth) for of in zip(A, b, strict=True))
    shown = (warp(frames[j], way, EVERY_PX) for j, way in zip(others, ways, strict=True))
    expected = np.stack([exposed(frames[i], there) for there in shown])
    pictures, covers = (np.stack([of[j] for j in others]) for of in (frames, covered))
    return Around(pictures, expected, covers, *of_rows(A, b))


def seen_again(limit: np.ndarray, depths: list[np.ndarray], around: Around) -> np.ndarray:
    """Difference [h, w] in colour levels of a frame to those frames in which movers do not cover what its pixels show.

    The least over the static `depths` [h, w] of the ALIKE quantile over the frames that show the place uncovered.
    Infinite where fewer than LEAST_FRAMES do, and from the `limit` [h, w] on: a limit of 0 spares a pixel.
    """
    limit, found = limit.astype(np.float32), np.full(limit.shape, np.inf, np.float32)
    v, u = (np.ascontiguousarray(of) for of in np.nonzero(limit > 0))
    least, places = limit[v, u], np.empty((len(around.covered), 3))
    static = np.stack([depth[v, u] for depth in depths])
    flat = around.pictures.reshape(-1), around.expected.reshape(-1)
    _seen_again(*flat, *around[2:], u, v, static, least, np.empty(len(places)), places)
    found[v, u] = np.where(least < limit[v, u], least, np.inf)
    return found


@numba.njit(**KERNEL)
def _seen_again(images, expected, covered, A, b, u, v, depths, least, alike, places):  # type: ignore[no-untyped-def]
    """Lower the `least` difference [n] float32 of pixels u, v [n] to images [F, h, w, 3], given as one row, over their
    `depths` [d, n].

    What is not below the least so far need not be known: the quantile is among the others, which are sorted in `alike`
    [F], or they are too few. `places` [F, 3] are the frames that show the place uncovered, and where they do.
    """
    size = covered.shape[1:]
    for k in range(len(u)):
        for d in range(len(depths)):
            shown = 0
            for j in range(len(covered)):
                x, y = place(A, b, j, u[k], v[k], depths[d, k])
                if is_uncovered(covered, j, x, y):
                    places[shown, 0], places[shown, 1], places[shown, 2] = j, x, y
                    shown += 1
            if shown < LEAST_FRAMES:
                continue
            rank, count, most = round(ALIKE * (shown - 1)), 0, least[k]
            for s in range(shown):
                j, x, y = int(places[s, 0]), places[s, 1], places[s, 2]
                apart = window_difference(images, expected, size, j, u[k], v[k], x, y, HALF_WINDOW, most)
                if apart < most:
                    count = _insert(alike, count, apart)
                    if count > rank:
                        most = alike[rank]
                if count + shown - s - 1 <= rank:
                    break
            least[k] = most


@numba.njit(**KERNEL)
def _insert(values, count, value):  # type: ignore[no-untyped-def]
    """Insert a value into the first `count` values, which ascend; one more than these."""
    more = count + 1
    while count > 0 and values[count - 1] > value:
        values[count] = values[count - 1]
        count -= 1
    values[count] = value
    return more


@numba.njit(**KERNEL)
def is_uncovered(covered, j, x, y):  # type: ignore[no-untyped-def]
    """Whether a place is in the image, and none of the four pixels around it is `covered` [F, h, w]."""
    h, w = covered.shape[1:]
    if not (0 <= x <= w - 1 and 0 <= y <= h - 1):
        return False
    left, top = int(x), int(y)
    right, low = min(left + 1, w - 1), min(top + 1, h - 1)
    above, below = covered[j, top, left] or covered[j, top, right], covered[j, low, left] or covered[j, low, right]
    return not (above or below)
