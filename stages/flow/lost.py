"""Small things that move fast: dense search loses them, so their patches are searched again.

On the coarse levels of its pyramid a thing is gone that moves farther than its own size. Its pixels then follow what is
behind it, forward and backward alike, and only the pictures contradict. Where they do, patches of frames of half the
size are matched exhaustively.
"""

import cv2
import numpy as np

from stages.flow.confidence import photometric_ratio
from stages.flow.dis import solve_pair
from stages.flow.matches import RESIDUAL_WINDOW_PX, photometric_residual
from stages.shared.warp import warp

LOST, FOUND = 6.0, 4.0
"""Photometric residual, as a multiple of the frame's median, from which on a pixel is lost, and up to which one counts
as found."""
PROMISING, BETTER = 0.8, 0.5
"""Largest share of the residual before that a patch may leave, right to two pixels, for a new search to be made, and
that the new flow may: what is hidden in the other frame matches by chance."""
MOST = 0.2
"""Pairs of which a larger share is lost keep their flow: no thing in them is lost, but the pair."""
WIDTH_PX = 5
"""Least width of what is lost, and of what is found."""
REACH, HALF_PATCH = 16, 2
"""Of the search, in pixels of frames of half the size."""


def with_lost(flow: np.ndarray, source: np.ndarray, target: np.ndarray, finest_scale: int) -> np.ndarray:
    """Flow [h, w, 2] px between grey frames [h, w] uint8, replaced where a search for what was lost explains them.

    Args:
        finest_scale: as in `solve_pair`.
    """
    lost = _wide(photometric_ratio(flow, source, target) > LOST)
    if not lost.any() or lost.mean() > MOST:
        return flow
    brighter = np.median((warp(target.astype(np.float32), flow) - source)[::2, ::2])
    target = np.clip(target - brighter, 0, 255).astype(np.uint8)
    start = _searched(flow, lost, source, target)
    before = photometric_residual(flow, source, target)
    if not _wide(lost & (photometric_residual(start, source, target) < PROMISING * before)).any():
        return flow
    anew = solve_pair(source, target, start, finest_scale)
    after = photometric_residual(anew, source, target)
    near = _grown(lost, WIDTH_PX)
    found = _wide(near & (after < BETTER * before) & (photometric_ratio(anew, source, target) < FOUND))
    kept = near & (after < before) & _grown(found, RESIDUAL_WINDOW_PX)  # at a rim the residual is one of both sides
    return np.where(kept[..., None], anew, flow)


def _searched(flow: np.ndarray, lost: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Flow [h, w, 2] px, of lost pixels [h, w] that of the best match of a patch within reach of where it leads."""
    h, w = lost.shape
    size = w // 2, h // 2
    here, there, chosen = (
        cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (source, target, lost.astype(np.float32))
    )
    here = np.pad(here, HALF_PATCH, mode="edge")
    there = np.pad(there, HALF_PATCH + REACH, mode="edge")
    patch, reach = 2 * HALF_PATCH + 1, 2 * (HALF_PATCH + REACH) + 1
    shifts = cv2.resize(flow, size, interpolation=cv2.INTER_AREA) / 2
    for y, x in np.argwhere(chosen >= 0.5):
        u0, v0 = np.clip(np.rint(shifts[y, x] + (x, y)), 0, (size[0] - 1, size[1] - 1)).astype(int)
        around, own = there[v0 : v0 + reach, u0 : u0 + reach], here[y : y + patch, x : x + patch]
        _, _, (u, v), _ = cv2.minMaxLoc(cv2.matchTemplate(around, own, cv2.TM_SQDIFF))
        shifts[y, x] = u0 + u - REACH - x, v0 + v - REACH - y
    smooth = cv2.merge([cv2.medianBlur(channel, WIDTH_PX) for channel in cv2.split(shifts)])
    found = 2 * cv2.resize(smooth, (w, h), interpolation=cv2.INTER_NEAREST)
    return np.where(lost[..., None], found, flow).astype(np.float32)


def _wide(mask: np.ndarray) -> np.ndarray:
    """What of a mask [h, w] is at least WIDTH_PX wide."""
    kernel = np.ones((WIDTH_PX, WIDTH_PX), np.uint8)
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0)


def _grown(mask: np.ndarray, width_px: int) -> np.ndarray:
    """A mask [h, w] grown by a square of this width."""
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((width_px, width_px), np.uint8)) > 0)
