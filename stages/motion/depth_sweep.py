"""The static depth at which a pixel matches other pictures best, whatever its flow and the depths around it say.

It is searched for from infinity on (plane sweep; Collins, CVPR 1996).
"""

from typing import NamedTuple

import cv2
import numba
import numpy as np

from stages.shared.window_kernels import KERNEL, of_rows, place, window_difference

STEPS, STEP_PX = 40, 1.0
"""Depths that are tried at most, beside infinity, and the longest way in the image, from one frame to the next, from
infinity to the first."""
REFINEMENTS = 2
"""Halvings of that step, around the best depth."""
HALF_WINDOW = 2
"""Pixels of the compared windows on either side of their middle."""
MOST_OF, NEARER = 0.95, 12.0
"""Searched up to NEARER times the inverse depth that MOST_OF of the static pixels stay below, as far as STEPS reach."""
HARDLY_PX, LITTLE_NEARER = 1.0, 4.0
"""Where the camera passes those by less than HARDLY_PX a frame, it hardly moves, and all that moves along its lines of
sight would lie at some depth: then searched up to LITTLE_NEARER times."""


class Other(NamedTuple):
    """Another frame beside this one.

    Attributes:
        step: frames to it. found: [h, w, 3] uint8. expected: [h, w, 3] uint8, this frame at its exposure.
        by_flow: [h, w] difference of both along the flow, in colour levels, 0 where it leads out of view.
        inside: [h, w], where it does not. A, b: [3, 3] and [3], projection of this frame's pixels, or of every row.
    """

    step: int
    found: np.ndarray
    expected: np.ndarray
    by_flow: np.ndarray
    inside: np.ndarray
    A: np.ndarray
    b: np.ndarray


def worse_side(others: list[Other]) -> np.ndarray:
    """Mean difference [h, w] along the flow, to the earlier or the later frames, whichever is larger."""
    sides = [[other for other in others if (other.step > 0) == later] for later in (False, True)]
    means = [
        sum(other.by_flow for other in side) / np.maximum(sum(other.inside.astype(np.float32) for other in side), 1)
        for side in sides
        if side
    ]
    return np.asarray(np.maximum.reduce(means))


def hardly_moves(steps: np.ndarray, b: np.ndarray, static: np.ndarray, size: tuple[int, int]) -> bool:
    """Whether the camera passes MOST_OF the static pixels by less than HARDLY_PX a frame in pictures [h, w].

    Args:
        steps: [n] frames to the others. b: [n, 3] of their projections, or [n, h, 3]. static: [m] inverse depths.
    """
    if not len(steps) or not static.size:
        return True
    return float(np.quantile(static, MOST_OF)) * _way_px(steps, b, size) < HARDLY_PX


def reach(others: list[Other], static: np.ndarray, size: tuple[int, int]) -> float:
    """The inverse depth up to which is searched, by those [m] of static pixels, in pictures [h, w]."""
    hardly = hardly_moves(*_ways(others), static, size)
    return (LITTLE_NEARER if hardly else NEARER) * float(np.quantile(static, MOST_OF))


def _ways(others: list[Other]) -> tuple[np.ndarray, np.ndarray]:
    """Steps [n] and b [n, 3] or [n, h, 3] of the frames."""
    return np.array([other.step for other in others]), np.stack([other.b for other in others])


def _way_px(steps: np.ndarray, b: np.ndarray, size: tuple[int, int]) -> float:
    """The longest way in the image, [h, w], from infinity to an inverse depth of 1, in the nearest of the frames."""
    h, w = size
    corners = np.array([[0, 0], [w, 0], [0, h], [w, h]], float)
    nearest = b.reshape(len(b), -1, 3)[np.abs(steps) == np.abs(steps).min()].mean(axis=1)
    return float(np.linalg.norm(nearest[:, None, :2] - nearest[:, None, 2:] * corners, axis=-1).max())


def least_difference(others: list[Other], sought: np.ndarray, nearest: float) -> np.ndarray:
    """Least mean difference [h, w] to other frames over the static depths, up to the inverse depth `nearest`, in colour
    levels; infinite where nothing is `sought` [h, w] or no depth is in view."""
    near = sorted(others, key=lambda other: abs(other.step))
    first = sum(abs(other.step) == abs(near[0].step) for other in near)
    way_px = _way_px(*_ways(others), sought.shape)
    least = np.full(sought.shape, np.inf, np.float32)
    if way_px == 0:  # a camera that turns sees all depths at one place
        return least
    pictures = [np.stack([getattr(other, name) for other in near]) for name in ("found", "expected")]
    greys = [np.stack([cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in of[:first]]) for of in pictures]
    flat = [of.reshape(-1) for of in (*greys, *pictures)]
    A, b = of_rows(*(np.stack([getattr(other, name) for other in near]).astype(np.float32) for name in ("A", "b")))
    later = np.array([other.step > 0 for other in near])
    v, u = np.nonzero(sought)
    found, unit = np.empty(len(u), np.float32), STEP_PX / way_px
    steps = min(int(np.ceil(nearest / unit)), STEPS)
    depths = np.linspace(0, min(nearest, STEPS * unit), 1 + max(steps, 1)).astype(np.float32)
    _search(*flat, sought.shape, first, A, b, later, u, v, depths, found)
    least[v, u] = found
    return least


@numba.njit(**KERNEL)
def _search(grey, grey_expected, images, expected, size, first, A, b, later, u, v, depths, least):  # type: ignore[no-untyped-def]
    """Fill the least difference [n] float32 of pixels u, v [n] int64: first over the `depths` [d] float32, at whole
    pixels of the `first`, nearest frames in grey [first, h, w] uint8, then around the best of them in all frames
    [F, h, w, 3], by A [F, R, 3, 3] and b [F, R, 3] float32. Pictures are given as one row, and their size (h, w)."""
    for k in range(len(u)):
        most, depth = np.float32(np.inf), np.float32(0)
        for d in depths:
            found = _grey_difference(grey, grey_expected, size, first, A, b, u[k], v[k], d, most)
            if found < most:
                most, depth = found, d
        best, width = _difference(images, expected, size, A, b, later, u[k], v[k], depth), depths[1] / 2
        for _ in range(REFINEMENTS):
            for d in (max(depth - width, depths[0]), min(depth + width, depths[-1])):
                found = _difference(images, expected, size, A, b, later, u[k], v[k], d)
                if found < best:
                    best, depth = found, d
            width /= 2
        least[k] = best


@numba.njit(**KERNEL)
def _grey_difference(images, expected, size, frames, A, b, u, v, depth, most):  # type: ignore[no-untyped-def]
    """Mean difference of a pixel's window at an inverse depth, of the worst frame; infinite from `most` on, and where
    no frame shows it."""
    h, w = size
    worst = np.float32(-1)
    for j in range(frames):
        x_px, y_px = place(A, b, j, u, v, depth)
        x, y = int(np.rint(x_px)), int(np.rint(y_px))
        if x < 0 or y < 0 or x >= w or y >= h:
            continue
        first, last = max(-HALF_WINDOW, -v, -y), min(HALF_WINDOW, h - 1 - v, h - 1 - y)
        begin, end = max(-HALF_WINDOW, -u, -x), min(HALF_WINDOW, w - 1 - u, w - 1 - x)
        at, here = (j * h + y + first) * w + x + begin, (j * h + v + first) * w + u + begin
        total, values = np.int32(0), end - begin + 1
        for _ in range(first, last + 1):
            for k in range(values):
                total += abs(np.int32(images[np.uint64(at + k)]) - np.int32(expected[np.uint64(here + k)]))
            if total >= most * (2 * HALF_WINDOW + 1) ** 2:
                return np.float32(np.inf)
            at, here = at + w, here + w
        worst = max(worst, np.float32(total / (values * (last - first + 1))))
        if worst >= most:
            return np.float32(np.inf)
    return worst if worst >= 0 else np.float32(np.inf)


@numba.njit(**KERNEL)
def _difference(images, expected, size, A, b, later, u, v, depth):  # type: ignore[no-untyped-def]
    """Mean difference of a pixel's window at an inverse depth, of the worse side; infinite where no frame shows it."""
    h, w = size
    before, befores, after, afters = np.float32(0), 0, np.float32(0), 0
    for j in range(len(later)):
        x, y = place(A, b, j, u, v, depth)
        if not (0 <= x <= w - 1 and 0 <= y <= h - 1):
            continue
        apart = window_difference(images, expected, size, j, u, v, x, y, HALF_WINDOW, np.inf)
        if later[j]:
            after, afters = after + apart, afters + 1
        else:
            before, befores = before + apart, befores + 1
    if befores + afters == 0:
        return np.float32(np.inf)
    return np.float32(max(before / max(befores, 1), after / max(afters, 1)))
