"""Evidence of motion from what a thing hides: static surface that, by its depth, would stand in front of it.

What moves the way the camera moves, and more slowly, is seen like something static that is farther away: flow finds a
depth for it, behind what it stands in front of. But it hides that surface. A surface that two frames show where its
depth says, and that a third does not show there although what is seen there seems farther, is hidden by something whose
depth is not the one that its flow tells: it moves (occlusion order; Ogale, Fermueller and Aloimonos, PAMI 2005).
"""

from functools import partial
from typing import NamedTuple

import cv2
import numpy as np

from stages.motion.epipolar import Evidence
from stages.motion.shadows import log_detail, patches
from stages.shared.cameras import projection, static_flow
from stages.shared.flow_pairs import BLOCK
from stages.shared.log import progress
from stages.shared.threads import threaded

GAPS = 2, 4, 6, 8, 12, 16
"""Frames between that in which a surface is seen and that in which it is hidden, either way."""
AGAIN = 2
"""Frames, away from that in which it is hidden, to where it must be seen again."""
FITS, LEAST_WEIGHT = 0.2, 0.3
"""Largest residual of a surface to the static world, and least weight, as a share of the median weight."""
FLAT = 0.3
"""Range of inverse depth around a pixel of it, at most, as a share of its own."""
NEARER = 1.08
"""It must seem nearer than all around the place where it is hidden, by this factor."""
AROUND_PX, PATCH_PX = 7, 5
TEXTURED = 4.0
"""Texture of its patch, in variances of the noise, at least."""
SEEN, HIDDEN = (0.25, 2.0), (0.8, 4.0)
"""Squared difference of patches up to which it is seen, and from which on it is hidden: as a share of the texture, plus
so many variances of the noise."""
LEAST_VOTES, SHARE = 4, 0.6
"""Pixels of such surfaces that must be hidden within 3 x 3 px of the image, over all frames, and their least share."""
VOTES_PX = 3


class StaticSurface(NamedTuple):
    """A frame's static surface.

    Attributes:
        detail: [h, w]; texture: [h, w], mean square of the detail of a patch; noise: variance of the detail.
        inverse_depth, nearest: [h, w], of a pixel, and the nearest around it.
        sure: [h, w], where the depth fits the flow, is flat and textured.
    """

    detail: np.ndarray
    texture: np.ndarray
    noise: float
    inverse_depth: np.ndarray
    nearest: np.ndarray
    sure: np.ndarray


def hiding(
    rgb: np.ndarray, cameras: tuple[np.ndarray, np.ndarray], inverse_depth: np.ndarray, evidence: Evidence
) -> np.ndarray:
    """Where [T, h, w] bool something hides static surface that seems nearer.

    Args:
        rgb: [T, h, w, 3] uint8 frames on the flow grid. cameras: cam_from_world [T, 4, 4], Ks [T, 3, 3] on the grid.
        inverse_depth, evidence: of `resweep.camera_evidence`.
    """
    T, reach = len(rgb), GAPS[-1] + AGAIN
    least = LEAST_WEIGHT * float(np.median(evidence.weight))
    found = np.empty(inverse_depth.shape, bool)
    surfaces: dict[int, StaticSurface] = {}

    def surface(k: int) -> StaticSurface:
        return _surface(rgb[k], inverse_depth[k], (evidence.residual[k] < FITS) & (evidence.weight[k] > least))

    for first in progress(range(0, T, BLOCK), "what movers hide"):
        last = min(first + BLOCK, T)
        near = range(max(first - reach, 0), min(last + reach, T))
        new = [k for k in near if k not in surfaces]
        kept = {k: of for k, of in surfaces.items() if k in near}
        surfaces = kept | dict(zip(new, threaded(surface, new), strict=True))
        found[first:last] = threaded(partial(_hides, surfaces, cameras), range(first, last))
    return found


def _surface(rgb: np.ndarray, inverse_depth: np.ndarray, fits: np.ndarray) -> StaticSurface:
    """The surface of a frame; fits: [h, w], where the flow fits the depth."""
    detail = np.ascontiguousarray(log_detail(rgb)[..., 1])
    depth = inverse_depth.astype(np.float32)
    noise = 1.4826 * float(np.median(np.abs(detail - cv2.blur(detail, (3, 3)))))
    texture = cv2.blur(detail**2, (PATCH_PX, PATCH_PX))
    around = np.ones((AROUND_PX, AROUND_PX), np.uint8)
    nearest, farthest = cv2.dilate(depth, around), cv2.erode(depth, around)
    sure = fits & (nearest - farthest < FLAT * depth) & (texture > TEXTURED * noise**2)
    return StaticSurface(detail, texture, noise**2, depth, nearest, sure)


def _hides(surfaces: dict[int, StaticSurface], cameras: tuple[np.ndarray, np.ndarray], j: int) -> np.ndarray:
    """Where [h, w] frame j shows something that hides surfaces of other frames."""
    here = surfaces[j]
    hidden, expected = np.zeros((2, *here.detail.shape), np.float32)
    for gap in GAPS:
        for way in (1, -1):
            i, again = j + way * gap, j + way * (gap + AGAIN)
            if not all(k in surfaces and surfaces[k].sure.any() for k in (i, j, again)):
                continue  # beyond the clip, or without evidence: such cameras are interpolated
            v, u, unseen = _nearer(surfaces[i], here, surfaces[again], *(_between(cameras, i, k) for k in (j, again)))
            np.add.at(expected, (v, u), 1)
            np.add.at(hidden, (v, u), unseen)
    hidden, expected = (cv2.boxFilter(of, -1, (VOTES_PX, VOTES_PX), normalize=False) for of in (hidden, expected))
    return np.asarray((hidden >= LEAST_VOTES) & (hidden > SHARE * expected))


Projection = tuple[np.ndarray, np.ndarray]
"""A [3, 3] and b [3] of `cameras.projection`."""


def _between(cameras: tuple[np.ndarray, np.ndarray], i: int, j: int) -> Projection:
    poses, Ks = cameras
    return projection((poses[i], Ks[i]), (poses[j], Ks[j]))


def _nearer(
    source: StaticSurface, target: StaticSurface, again: StaticSurface, to_target: Projection, to_again: Projection
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows and columns [n] of the target where surface of the source would be nearer than what is there, and whether it
    is hidden there; only surface that is seen again counts."""
    v, u = np.nonzero(source.sure)
    uv, depth = np.stack([u, v], axis=1).astype(float), source.inverse_depth[v, u].astype(float)
    moved, ratio = static_flow(uv, depth, *to_target)
    there = uv + moved
    h, w = target.detail.shape
    margin = PATCH_PX // 2 + 1
    inside = (ratio > 0) & (there >= margin).all(axis=1) & (there < (w - margin - 1, h - margin - 1)).all(axis=1)
    column, row = np.rint(np.where(inside[:, None], there, 0)).astype(int).T
    kept = inside & (depth > NEARER * ratio * target.nearest[row, column])
    v, u, row, column, there = v[kept], u[kept], row[kept], column[kept], there[kept]
    uv, depth = uv[kept], depth[kept]
    texture, seen_at = source.texture[v, u], uv + static_flow(uv, depth, *to_again)[0]
    patch = patches(source.detail, uv, PATCH_PX)
    seen = _difference(patch, again.detail, seen_at) < SEEN[0] * texture + SEEN[1] * source.noise
    unseen = _difference(patch, target.detail, there) > HIDDEN[0] * texture + HIDDEN[1] * source.noise
    return row[seen], column[seen], unseen[seen]


def _difference(patch: np.ndarray, detail: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Mean squared difference [n] of patches [n, PATCH_PX^2] to those around pixels uv [n, 2]."""
    return np.asarray(((patches(detail, uv, PATCH_PX) - patch) ** 2).mean(axis=1))
