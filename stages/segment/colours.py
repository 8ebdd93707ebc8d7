"""What colours say: whether a pixel at the border of a mask looks like what is within it near by, or like what is not.

Evidence of motion is blurred at borders: flow leaks over some pixels, and what a mover uncovers is in no other frame.
Its colours are not. Near every place two histograms are learnt, of what is surely inside and surely outside of the
mask; both lie in one grid over places and colours (the bilateral grid of Chen et al., SIGGRAPH 2007; in segmentation of
video that of Maerki et al., CVPR 2016), into which pixels are splatted and from which they are read multilinearly.
"""

import cv2
import numba
import numpy as np

from stages.segment.extension import extend, weigh
from stages.shared.images import relative_size
from stages.shared.window_kernels import KERNEL

CELL_PX, BIN = 64.0, 12.0
"""Distance of the grid's nodes, in frames of REFERENCE_PX and in colour levels (CIELAB, 0..255)."""
LEARNT_PX, ASKED_PX = 3.0, 24.0
"""Distance from the border of the mask, in frames of REFERENCE_PX, from which on colours are learnt, and up to which
they are asked. Nearly all of what is masked or missed by mistake lies within these."""
EVERY_PX = 2.0
"""Distance of the pixels that are learnt, likewise."""
THICK_PX, BESIDE_PX = 6.0, 9.0
"""What lies farther than BESIDE_PX from all that is THICK_PX within the mask, likewise, is not denied: too little is
learnt of thin and small things, and beside a larger mover their colours would be those of the ground."""
SURE = 0.3
"""How far from 1/2 the sureness of a pixel lies that is learnt fully."""
ENOUGH = 0.02
"""Share of a cell that must be learnt from, of either side, for its colours to count half."""
RARE = 1e-3
"""Share of the pixels around that have a colour at which it tells half."""
TINY = 1e-6


def colour_evidence(sureness: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """How clearly [H, W] float32 the colours say of each pixel that it moves, -1 (it does not) to 1.

    With the shares p and q of the pixels around, inside and outside of the mask, that have its colour:
    (p - q) / (p + q), less for rare colours and where little was learnt, times the root of how well that tells the
    pixels around from which it was learnt: of its means over those inside and over those outside, there negated, the
    smaller counts. It is 0 where both look alike. 0, too, farther than ASKED_PX from the border of the mask.

    Args:
        sureness: [H, W] in 0..1, above 1/2 inside of the mask. rgb: [H, W, 3] uint8.
    """
    px = relative_size(rgb)
    inside = (sureness > 0.5).astype(np.uint8)
    depths = [_distance(of) for of in (inside, 1 - inside)]
    if not all(depth.any() for depth in depths):
        return np.zeros(sureness.shape, np.float32)
    asked = np.maximum(*depths) <= ASKED_PX * px
    step = max(1, round(EVERY_PX * px))
    some, cell_px = np.s_[::step, ::step], CELL_PX * px
    clear = np.clip(np.abs(sureness - 0.5) / SURE, 0, 1) * (np.maximum(*depths) <= ASKED_PX * px + cell_px)
    learnt = np.dstack([(depth > LEARNT_PX * px) * clear for depth in depths])[some].astype(np.float32) * step**2
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB)
    lab -= np.array([of.min() for of in cv2.split(lab)])
    size = [int(n / cell_px) + 2 for n in sureness.shape] + [int(of.max() / BIN) + 2 for of in cv2.split(lab)]
    grid, shares = np.zeros((*size, 2), np.float32), np.empty((5, 2))
    _splat(np.ascontiguousarray(lab[some]), learnt, step / cell_px, grid, shares)
    found, read = np.zeros((*sureness.shape, 2), np.float32), asked.copy()
    read[some] |= learnt.any(axis=2)
    _slice(lab, read, 1 / cell_px, grid, grid.sum(axis=(2, 3, 4)), found, shares)
    told = found[..., 0] * found[..., 1] / (found[..., 1] + ENOUGH * cell_px**2)
    own = [weigh(sign * told[some][..., None], learnt[..., side]) for side, sign in enumerate((1, -1))]
    tells = np.minimum(*(extend(of, cell_px / 2 / step)[0][..., 0] for of in own))
    told *= np.sqrt(np.clip(cv2.resize(tells, sureness.shape[::-1]), 0, 1))
    thin = (inside > 0) & (_distance((depths[0] <= THICK_PX * px).astype(np.uint8)) > BESIDE_PX * px)
    return np.where(asked, np.where(thin, np.maximum(told, 0), told), 0).astype(np.float32)


def _distance(mask: np.ndarray) -> np.ndarray:
    """Distance [H, W] px of the pixels of a mask [H, W] uint8 from what is not in it; 0 outside."""
    return np.asarray(cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_3))


@numba.njit(**KERNEL)
def _splat(lab, weights, per_px, grid, shares):  # type: ignore[no-untyped-def]
    """Add the weights [h, w, 2] of pixels of colours lab [h, w, 3] uint8 to the grid [y, x, l, a, b, 2].

    `shares` [5, 2] is for what `_tents` gives.
    """
    for v in range(lab.shape[0]):
        j = _tents(v * per_px, shares[0])
        for u in range(lab.shape[1]):
            inner, outer = weights[v, u, 0], weights[v, u, 1]
            if inner == 0 and outer == 0:
                continue
            i = _tents(u * per_px, shares[1])
            k, m, n = _colour(lab, v, u, shares)
            for y, x, c, d, e in np.ndindex(2, 2, 2, 2, 2):
                share = shares[0, y] * shares[1, x] * shares[2, c] * shares[3, d] * shares[4, e]
                grid[j + y, i + x, k + c, m + d, n + e, 0] += share * inner
                grid[j + y, i + x, k + c, m + d, n + e, 1] += share * outer


@numba.njit(**KERNEL)
def _slice(lab, read, per_px, grid, totals, found, shares):  # type: ignore[no-untyped-def]
    """Into found [H, W, 2], where read: (p - q) / (p + q), and how much was learnt there of the side of which less was.

    `totals` [y, x, 2] are the sums of the grid over all colours, `shares` [5, 2] is for what `_tents` gives.
    """
    for v in range(lab.shape[0]):
        j = _tents(v * per_px, shares[0])
        for u in range(lab.shape[1]):
            if not read[v, u]:
                continue
            i = _tents(u * per_px, shares[1])
            k, m, n = _colour(lab, v, u, shares)
            inner, outer, all_inner, all_outer = 0.0, 0.0, 0.0, 0.0
            for y, x in np.ndindex(2, 2):
                here = shares[0, y] * shares[1, x]
                all_inner += here * totals[j + y, i + x, 0]
                all_outer += here * totals[j + y, i + x, 1]
                for c, d, e in np.ndindex(2, 2, 2):
                    share = here * shares[2, c] * shares[3, d] * shares[4, e]
                    inner += share * grid[j + y, i + x, k + c, m + d, n + e, 0]
                    outer += share * grid[j + y, i + x, k + c, m + d, n + e, 1]
            p, q = inner / max(all_inner, TINY), outer / max(all_outer, TINY)
            found[v, u, 0] = (p - q) / (p + q + RARE)
            found[v, u, 1] = min(all_inner, all_outer)


@numba.njit(**KERNEL)
def _colour(lab, v, u, shares):  # type: ignore[no-untyped-def]
    """The lower nodes of a pixel's colour, with the shares of both in the last three of `shares` [5, 2]."""
    return (
        _tents(lab[v, u, 0] / BIN, shares[2]),
        _tents(lab[v, u, 1] / BIN, shares[3]),
        _tents(lab[v, u, 2] / BIN, shares[4]),
    )


@numba.njit(**KERNEL)
def _tents(place, shares):  # type: ignore[no-untyped-def]
    """The lower of the two nodes around a place on an axis; into `shares` [2] those of both, which are linear."""
    node = int(place)
    shares[1] = place - node
    shares[0] = 1 - shares[1]
    return node
