"""What colours say: whether a pixel at the border of a mask looks like what is within it near by, or like what is not.

Evidence of motion is blurred at borders: flow leaks over some pixels, and what a mover uncovers is in no other frame.
Its colours are not. Near every place two histograms are learnt, of what is surely inside and surely outside of the
mask; both lie in one grid over places and colours (the bilateral grid of Chen et al., SIGGRAPH 2007; in segmentation of
video that of Maerki et al., CVPR 2016), into which pixels are splatted and from which they are read multilinearly.
Frames near by are splatted too: things keep their colours, while what is found of them comes and goes.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numba
import numpy as np

from stages.segment.extension import extend, weigh
from stages.shared.images import relative_size
from stages.shared.window_kernels import KERNEL

CELL_PX, BIN = 64.0, 8.0
"""Distance of the grid's nodes, in frames of REFERENCE_PX and in colour levels (CIELAB, 0..255)."""
LEARNT_PX, ASKED_PX = 3.0, 48.0
"""Distance from the border of the mask, in frames of REFERENCE_PX, from which on colours are learnt, and up to which
they are asked. Nearly all of what is masked or missed by mistake lies within these."""
EVERY_PX = 4.0
"""Distance of the pixels that are learnt, likewise."""
THICK_PX, BESIDE_PX = 6.0, 9.0
"""What lies farther than BESIDE_PX from all that is THICK_PX within the mask, likewise, is not denied: too little is
learnt of thin and small things, and beside a larger mover their colours would be those of the ground."""
SURE = 0.3
"""How far from 1/2 the sureness of a pixel lies that is learnt fully."""
ENOUGH = 0.02
"""Share of a cell that must be learnt from, of either side, all frames together, for its colours to count half."""
RARE = 3e-4
"""Share of the pixels around that have a colour at which it tells half. A finer BIN holds less of them."""
TINY = 1e-6


class Learnt(NamedTuple):
    """What a frame teaches of the colours inside and outside of its mask, by one pixel in `_step` each way.

    Attributes:
        lab: [h, w, 3] uint8. weights: [h, w, 2] float32, with which it is learnt as inside, and as outside.
    """

    lab: np.ndarray
    weights: np.ndarray


def learn(sureness: np.ndarray, rgb: np.ndarray) -> Learnt:
    """What colours are surely inside, and surely outside, near the border of a mask.

    Args:
        sureness: [H, W] in 0..1, above 1/2 inside of the mask. rgb: [H, W, 3] uint8.
    """
    px, some = relative_size(rgb), np.s_[:: _step(rgb), :: _step(rgb)]
    depth, sure = border_distance(sureness)[some], np.clip(np.abs(sureness[some] - 0.5) / SURE, 0, 1)
    sure *= np.abs(depth) <= (ASKED_PX + CELL_PX) * px
    weights = np.dstack([(side > LEARNT_PX * px) * sure for side in (depth, -depth)])
    return Learnt(cv2.cvtColor(rgb[some], cv2.COLOR_RGB2LAB), weights.astype(np.float32))


def colour_evidence(sureness: np.ndarray, rgb: np.ndarray, own: Learnt, others: Sequence[Learnt] = ()) -> np.ndarray:
    """How clearly [H, W] float32 the colours say of each pixel that it moves, -1 (it does not) to 1.

    With the shares p and q of the pixels around, inside and outside of the masks, that have its colour:
    (p - q) / (p + q), less for rare colours and where little was learnt, times the root of how well that tells the
    pixels around that this frame teaches: of its means over those inside and over those outside, there negated, the
    smaller counts. It is 0 where both look alike. 0, too, farther than ASKED_PX from the border of the mask.

    Args:
        sureness: [H, W] in 0..1, above 1/2 inside of the mask. rgb: [H, W, 3] uint8.
        own: what the frame teaches, of `learn`; others: what frames near by do, of the same size.
    """
    px, step, depth = relative_size(rgb), _step(rgb), border_distance(sureness)
    cell_px, some, asked = CELL_PX * px, np.s_[::step, ::step], np.abs(depth) <= ASKED_PX * px
    if not asked.any():
        return np.zeros(sureness.shape, np.float32)
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB)
    least, most = _range([lab, *(of.lab for of in others)])
    nodes = np.array([int(last) + 2 for last in (*(n / cell_px for n in depth.shape), *(most - least) / BIN)])
    grid = np.zeros((nodes[:2].prod(), nodes[2:].prod(), 2), np.float32)
    totals = np.zeros((len(grid), 2), np.float32)
    for of in (own, *others):
        _splat(of.lab, least, of.weights, step / cell_px, nodes, grid, totals)
    found, read = np.zeros((*depth.shape, 2), np.float32), asked.copy()
    read[some] |= own.weights.any(axis=2)
    _slice(lab, least, read, 1 / cell_px, nodes, grid, totals, found)
    told = found[..., 0] * found[..., 1] / (found[..., 1] + ENOUGH * (cell_px / step) ** 2)
    sides = [weigh(sign * told[some][..., None], own.weights[..., side]) for side, sign in enumerate((1, -1))]
    tells = np.minimum(*(extend(of, cell_px / 2 / step)[0][..., 0] for of in sides))
    told *= np.sqrt(np.clip(cv2.resize(tells, depth.shape[::-1]), 0, 1))
    thick = _distance((depth <= THICK_PX * px).astype(np.uint8)) <= BESIDE_PX * px
    return np.where(asked, np.where(thick | (depth < 0), told, np.maximum(told, 0)), 0).astype(np.float32)


def _range(frames: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The least and the largest level [3] of frames [h, w, 3] uint8."""
    found = [[(int(of.min()), int(of.max())) for of in cv2.split(frame)] for frame in frames]
    return np.min(found, axis=0)[:, 0], np.max(found, axis=0)[:, 1]


def border_distance(sureness: np.ndarray) -> np.ndarray:
    """How far [H, W] px within the mask, and, negative, outside of it; infinite if there is no border."""
    inside = (sureness > 0.5).astype(np.uint8)
    if inside.all() or not inside.any():
        return np.full(inside.shape, np.inf, np.float32)
    return _distance(inside) - _distance(1 - inside)


def _step(frame: np.ndarray) -> int:
    """Distance in pixels of those of a frame [H, W, 3] that are learnt."""
    return max(1, round(EVERY_PX * relative_size(frame)))


def _distance(mask: np.ndarray) -> np.ndarray:
    """Distance [H, W] px of the pixels of a mask [H, W] uint8 from what is not in it; 0 outside."""
    return np.asarray(cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_3))


@numba.njit(**KERNEL)
def _splat(lab, least, weights, per_px, nodes, grid, totals):  # type: ignore[no-untyped-def]
    """Add the weights [h, w, 2] of pixels of colours lab [h, w, 3] uint8 to the grid and to its sums over all colours.

    The grid is [N, C, 2], with `nodes` [5] along y, x (N together) and l, a, b (C together), these from the `least`
    levels [3] on. The sums are [N, 2].
    """
    at, around, share, likely = np.empty(4, np.int64), np.empty(8, np.int64), np.empty(4), np.empty(8)
    for v in range(lab.shape[0]):
        for u in range(lab.shape[1]):
            inner, outer = weights[v, u, 0], weights[v, u, 1]
            if inner == 0 and outer == 0:
                continue
            _corners((v * per_px, u * per_px), nodes[:2], at, share)
            light, a, b = lab[v, u, 0] - least[0], lab[v, u, 1] - least[1], lab[v, u, 2] - least[2]
            _corners((light / BIN, a / BIN, b / BIN), nodes[2:], around, likely)
            for n in range(4):
                totals[at[n], 0] += share[n] * inner
                totals[at[n], 1] += share[n] * outer
                for c in range(8):
                    grid[at[n], around[c], 0] += share[n] * likely[c] * inner
                    grid[at[n], around[c], 1] += share[n] * likely[c] * outer


@numba.njit(**KERNEL)
def _slice(lab, least, read, per_px, nodes, grid, totals, found):  # type: ignore[no-untyped-def]
    """Into found [H, W, 2], where read: (p - q) / (p + q), and how much was learnt there of the side of which less was.

    `lab` and `per_px` are those of all pixels; `nodes`, `grid` and `totals` as `_splat` leaves them.
    """
    at, around, share, likely = np.empty(4, np.int64), np.empty(8, np.int64), np.empty(4), np.empty(8)
    for v in range(lab.shape[0]):
        for u in range(lab.shape[1]):
            if not read[v, u]:
                continue
            _corners((v * per_px, u * per_px), nodes[:2], at, share)
            light, a, b = lab[v, u, 0] - least[0], lab[v, u, 1] - least[1], lab[v, u, 2] - least[2]
            _corners((light / BIN, a / BIN, b / BIN), nodes[2:], around, likely)
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
