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
    away = np.maximum(*depths)
    asked = away <= ASKED_PX * px
    step = max(1, round(EVERY_PX * px))
    some, cell_px = np.s_[::step, ::step], CELL_PX * px
    clear = np.clip(np.abs(sureness[some] - 0.5) / SURE, 0, 1) * (away[some] <= ASKED_PX * px + cell_px)
    learnt = np.dstack([(depth[some] > LEARNT_PX * px) * clear for depth in depths]).astype(np.float32) * step**2
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB)
    lab -= np.array([of.min() for of in cv2.split(lab)])
    places = *(n / cell_px for n in sureness.shape), *(of.max() / BIN for of in cv2.split(lab))
    nodes = np.array([int(last) + 2 for last in places])
    grid = np.zeros((nodes[:2].prod(), nodes[2:].prod(), 2), np.float32)
    totals = np.zeros((len(grid), 2), np.float32)
    _splat(np.ascontiguousarray(lab[some]), learnt, step / cell_px, nodes, grid, totals)
    found, read = np.zeros((*sureness.shape, 2), np.float32), asked.copy()
    read[some] |= learnt.any(axis=2)
    _slice(lab, read, 1 / cell_px, nodes, grid, totals, found)
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
def _splat(lab, weights, per_px, nodes, grid, totals):  # type: ignore[no-untyped-def]
    """Add the weights [h, w, 2] of pixels of colours lab [h, w, 3] uint8 to the grid and to its sums over all colours.

    The grid is [N, C, 2], with `nodes` [5] along y, x (N together) and l, a, b (C together). The sums are [N, 2].
    """
    at, around, share, likely = np.empty(4, np.int64), np.empty(8, np.int64), np.empty(4), np.empty(8)
    for v in range(lab.shape[0]):
        for u in range(lab.shape[1]):
            inner, outer = weights[v, u, 0], weights[v, u, 1]
            if inner == 0 and outer == 0:
                continue
            _corners((v * per_px, u * per_px), nodes[:2], at, share)
            _corners((lab[v, u, 0] / BIN, lab[v, u, 1] / BIN, lab[v, u, 2] / BIN), nodes[2:], around, likely)
            for n in range(4):
                totals[at[n], 0] += share[n] * inner
                totals[at[n], 1] += share[n] * outer
                for c in range(8):
                    grid[at[n], around[c], 0] += share[n] * likely[c] * inner
                    grid[at[n], around[c], 1] += share[n] * likely[c] * outer


@numba.njit(**KERNEL)
def _slice(lab, read, per_px, nodes, grid, totals, found):  # type: ignore[no-untyped-def]
    """Into found [H, W, 2], where read: (p - q) / (p + q), and how much was learnt there of the side of which less was.

    `lab` and `per_px` are those of all pixels; `nodes`, `grid` and `totals` as `_splat` leaves them.
    """
    at, around, share, likely = np.empty(4, np.int64), np.empty(8, np.int64), np.empty(4), np.empty(8)
    for v in range(lab.shape[0]):
        for u in range(lab.shape[1]):
            if not read[v, u]:
                continue
            _corners((v * per_px, u * per_px), nodes[:2], at, share)
            _corners((lab[v, u, 0] / BIN, lab[v, u, 1] / BIN, lab[v, u, 2] / BIN), nodes[2:], around, likely)
            inner, outer, all_inner, all_outer = 0.0, 0.0, 0.0, 0.0
            for n in range(4):
                all_inner += share[n] * totals[at[n], 0]
                all_outer += share[n] * totals[at[n], 1]
                for c in range(8):
                    inner += share[n] * likely[c] * grid[at[n], around[c], 0]
                    outer += share[n] * likely[c] * grid[at[n], around[c], 1]
            p, q = inner / max(all_inner, TINY), outer / max(all_outer, TINY)
            found[v, u, 0] = (p - q) / (p + q + RARE)
            found[v, u, 1] = min(all_inner, all_outer)


@numba.njit(**KERNEL)
def _corners(place, nodes, at, shares):  # type: ignore[no-untyped-def]
    """The 2^n nodes around a place on n axes, as indices into a grid with these nodes, and their multilinear shares."""
    at[0], shares[0], known = 0, 1.0, 1
    for axis in range(len(nodes)):
        lower = int(place[axis])
        upper_share = place[axis] - lower
        for c in range(known):
            at[known + c] = at[c] * nodes[axis] + lower + 1
            at[c] = at[known + c] - 1
            shares[known + c] = shares[c] * upper_share
            shares[c] -= shares[known + c]
        known *= 2
