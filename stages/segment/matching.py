"""Pictures compared with those near by, at the depths of the static scene and with the motion of what moves."""

import cv2
import numpy as np

from stages.segment.extension import extend, weigh
from stages.segment.permanence import DYNAMIC
from stages.segment.static_world import StaticWorld
from stages.shared.flow_pairs import FlowPairs
from stages.shared.images import relative_size
from stages.shared.masks import within
from stages.shared.picture_difference import EVERY_PX, difference, exposed
from stages.shared.planes import surrounding_plane
from stages.shared.static_flow import dense_static_flow
from stages.shared.warp import Part, look_up, warp

REACH = 5
"""Largest distance in frames between compared pictures: farther ones show other sides of a mover."""
MOTION_PX = 4.0, 10.0, 22.0
"""Standard deviations, in frames of REFERENCE_PX, over which the flow of a mover is averaged and extended: near its
parts move apart, far its whole moves on."""
BEHIND = 0.1, 0.2, 0.4
"""Widths, as a share of the longer side of the frame, of the squares whose planes may be behind a mover."""
AROUND_PX = 24.0
"""Width of the square, in frames of REFERENCE_PX, whose nearest and farthest depth a static pixel may have too."""
MEDIAN_PX, PATCH_PX = 5, 3
UNSURE_FLOW = 0.02
"""Weight of the flow of a mover where it has no confidence."""
LEAST_SHARE = 1e-3
"""Share of what is extended among the pixels around, below which nothing is known of it: the Gaussian is cut off."""


def static_depths(world: StaticWorld, k: int, static: np.ndarray) -> list[np.ndarray]:
    """Inverse depths [h, w] that a static pixel may have: its own, the farthest and nearest around, and behind movers.

    Its own is that at which its flow fits a static scene, if it does, else that of the narrowest plane. Planes are of
    what fits and does not move. In the adjustment, what was masked by mistake has the depth of a mover, at which it
    would match nowhere, and be masked for good: that counts where nothing fits near by.

    Args:
        static: [h, w] weight of a pixel for what is behind a mover.
    """
    fitted, fits = world.as_static(k)
    solved = cv2.medianBlur(world.inverse_depth(k), MEDIAN_PX)
    square = np.ones((round(AROUND_PX * relative_size(solved)),) * 2, np.uint8)
    around = [cv2.erode(solved, square), cv2.dilate(solved, square)]
    known = np.where(fits, static, 0).astype(np.float32)
    planes = [surrounding_plane(fitted, known, share) for share in BEHIND]
    narrow, *wide = (np.where(trust > LEAST_SHARE, plane, solved) for plane, trust in planes)
    return [np.where(fits, cv2.medianBlur(fitted, MEDIAN_PX), narrow), *around, *wide]


def compared(
    i: int,
    sure: np.ndarray,
    allowed: np.ndarray,
    depths: list[np.ndarray],
    pairs: FlowPairs,
    frames: dict[int, np.ndarray],
    world: StaticWorld,
) -> np.ndarray:
    """Static residual and that of the mover, in tolerances `allowed` [h, w], both 0 where nothing is compared; share of
    movers around; 1 where something is compared: [4, h, w].

    Nothing is where no mover is near. The better of earlier and later frames counts: what is hidden on one side is
    usually seen on the other.
    """
    mover = np.where(sure >= DYNAMIC, sure, 0)
    around = extend(weigh(mover[..., None], mover), MOTION_PX[-1] * relative_size(sure))[1]
    part = _bounds((mover > 0) | (around > LEAST_SHARE / (1 + UNSURE_FLOW)))
    mean = _residuals(i, mover, part, depths, pairs, frames, world)
    both = np.stack([mean[:, : len(depths)].min(axis=1), mean[:, len(depths) :].min(axis=1)], axis=1)
    side = both.min(axis=1).argmin(axis=0)
    better = np.take_along_axis(both, side[None, None], axis=0)[0] / allowed[part]
    known = np.isfinite(better).all(axis=0)
    found = np.zeros((4, *sure.shape), np.float32)
    found[:2, *part], found[2], found[3, *part] = np.where(known, better, 0), around, known
    return found


def _bounds(mask: np.ndarray) -> Part:
    """Rows and columns of the smallest rectangle that holds a mask [h, w] bool."""
    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    return slice(top, top + height), slice(left, left + width)


def _residuals(
    i: int,
    mover: np.ndarray,
    part: Part,
    depths: list[np.ndarray],
    pairs: FlowPairs,
    frames: dict[int, np.ndarray],
    world: StaticWorld,
) -> np.ndarray:
    """Mean difference to earlier and to later frames, of the pixels of a part at each depth and with each motion of the
    mover, [2, len(depths) + len(MOTION_PX), rows, columns] in colour levels; infinite where none shows the pixel.

    Args:
        mover: [h, w] weight of a pixel for the motion of the mover.
        part: rows and columns that are compared.
    """
    total, seen = np.zeros((2, 2, len(depths) + len(MOTION_PX), *mover[part].shape), np.float32)
    for e in pairs.leaving(i, i + 1):
        j = int(pairs.target[e])
        if abs(j - i) > REACH or not world.observed(i, j):
            continue
        A, b = world.projection(i, j)
        flow = pairs.flow[e].astype(np.float32)
        weight = mover * (pairs.confidence[e].astype(np.float32) + UNSURE_FLOW)
        ways = [dense_static_flow(A, b, depth) for depth in depths]
        weighted = weigh(flow, weight)
        extended = [extend(weighted, px * relative_size(mover)) for px in MOTION_PX]
        ways += [motion for motion, _ in extended]
        known = [True] * len(depths) + [share[part] > LEAST_SHARE for _, share in extended]
        expected = exposed(frames[i], warp(frames[j], flow, EVERY_PX))[part]
        for k, way in enumerate(ways):
            found, inside = look_up(frames[j], way, part)
            inside = (inside if pairs.scene is None else within(pairs.scene, way)[part]) & known[k]
            total[int(j > i), k] += inside * difference(found, expected, PATCH_PX)
            seen[int(j > i), k] += inside
    return np.asarray(np.where(seen > 0, total / np.maximum(seen, 1), np.inf))
