"""Whether gains act on the whole picture: what they save where pixels are followed by the flow, movers included."""

import cv2
import numpy as np

from stages.scene.geometry import LONGEST, MIN_CONFIDENCE
from stages.scene.observed import Observed
from stages.scene.sightings import CELLS
from stages.scene.weigh import NOTHING, Bought, weigh
from stages.scene.windows import SMOOTH_PX
from stages.shared.cameras import pixel_grid
from stages.shared.light import BRIGHT, DARK
from stages.shared.warp import bilinear

EDGES, STRIDE_PX = 60, 4
"""Edges of the flow that are followed at most, spread over the clip; distance of the pixels that are."""
GREY_LEVELS = 255.0
Followed = tuple[np.ndarray, np.ndarray, np.ndarray]


def followed_evidence(seen: Observed, log_gains: np.ndarray) -> tuple[Bought, Bought]:
    """What a gain per frame saves over none, and one per channel over that, in grey levels from frame to frame.

    Where most of the picture moves, what is left may be a single surface, whose shade changes as it turns. That looks
    like a gain there, but not in the rest of the picture.

    Args:
        log_gains: [F, 3], as in `Light`.
    """
    rows = np.flatnonzero(np.abs(seen.offsets) <= LONGEST)
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(EDGES, len(rows))).astype(int))]
    found = [_follow(seen, e) for e in rows]
    if not found:
        return NOTHING, NOTHING
    before, after, cell = (np.concatenate(part) for part in zip(*found, strict=True))
    change = np.repeat(np.diff(log_gains[seen.edges[rows]], axis=1)[:, 0], [len(part[2]) for part in found], axis=0)
    groups = np.repeat(cell, 3)
    same, one, three = (
        (GREY_LEVELS * (after * np.exp(-gain) - before)).ravel()
        for gain in (np.zeros(3), change.mean(axis=1, keepdims=True), change)
    )
    return weigh(same, one, groups), weigh(one, three, groups)


def _follow(seen: Observed, edge: int) -> Followed:
    """Colours [n, 3] of pixels of an edge's source, and where the flow leads in its target; and their tiles [n].

    Smoothed a little, since the flow is wrong by parts of a pixel.
    """
    (i, j), (h, w) = seen.edges[edge], seen.dynamic.shape[1:]
    uv = pixel_grid(h, w)[::STRIDE_PX, ::STRIDE_PX]
    to = uv + seen.flow[edge][::STRIDE_PX, ::STRIDE_PX]
    one, other = (cv2.GaussianBlur(seen.rgb[k], (0, 0), SMOOTH_PX) for k in (i, j))
    before, after = one[::STRIDE_PX, ::STRIDE_PX], bilinear(other, to)
    kept = (seen.confidence[edge][::STRIDE_PX, ::STRIDE_PX] >= MIN_CONFIDENCE) & _is_exposed(before, after)
    kept &= ((to >= 0) & (to <= (w - 1, h - 1))).all(axis=-1)
    if seen.scene is not None:
        kept &= seen.scene[::STRIDE_PX, ::STRIDE_PX]
    rows, columns = CELLS
    tile = (uv[..., 1] * rows // h) * columns + uv[..., 0] * columns // w
    return before[kept], after[kept], tile[kept].astype(int)


def _is_exposed(*colours: np.ndarray) -> np.ndarray:
    """Whether [h, w] no channel of any of these colours [h, w, 3] is clipped or mostly noise."""
    return np.all([((of > DARK) & (of < BRIGHT)).all(axis=-1) for of in colours], axis=0)
