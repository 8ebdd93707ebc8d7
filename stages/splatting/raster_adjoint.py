"""Numba kernels of the rasteriser's backward pass: gradients of every splat, summed in a fixed order.

Let g be the gradient of the loss L by a pixel. The backward pass repeats the compositing front to back and updates
S = g . (contribution of all that is behind the present splat), which starts at g . (final pixel). So no list of
contributing splats is stored, and no division by a transmittance near zero occurs:
dL/dalpha = T (g . colour) - S / (1 - alpha), where alpha is below MAX_ALPHA, at which it is cut.

With q = f0 dx + f1 dy, p = f2 dy, s = q^2 + p^2 and D = dL/ds, which is -alpha dL/dalpha, or 0 where alpha is cut, the
gradients of a splat follow from the moments of D over its pixels: the sums of D, D q, D p, D q^2, D q p and D p^2. Both
q and p are bounded where the splat is drawn, however elongated it is.
"""

from typing import Any

import numpy as np
from numba import njit

from stages.shared.lanes import LANES, load, prefetch, store, totals, trailing_zeros, where
from stages.shared.threads import spread
from stages.splatting.raster_bins import FAST, LIMIT, MASK, ONE, RANK, SLOT, TILE, WIDTH, ZERO
from stages.splatting.raster_kernels import (
    AHEAD,
    CHECK,
    MAX_ALPHA,
    MIN_TRANSMITTANCE,
    block_corner,
    block_offset,
    blocks_alive,
    exp_minus,
    place,
)

NOTHING = np.zeros(LANES, np.float32)
TWO = np.float32(2)


@njit(inline="always", **FAST)
def _adjoint_entry(splat: np.ndarray, mask: int, x0: int, y0: int, state: np.ndarray) -> Any:
    """Sums over one tile for one splat: six moments of D, then the gradients of its colour (3) and depth.

    Updates T and S in `state` from before the splat to after it.
    """
    T, S = state[0], state[1]
    opacity, r, g, b, z, limit = splat[5], splat[6], splat[7], splat[8], splat[9], splat[LIMIT]
    q0, p0 = block_corner(splat, x0, y0)
    none = load(NOTHING, 0)
    m, mq, mp, mqq, mqp, mpp, w0, w1, w2, w3 = none, none, none, none, none, none, none, none, none, none
    while mask:
        block = trailing_zeros(mask)
        mask &= mask - 1
        at = LANES * block
        q1, p1 = block_offset(splat, block)
        q, p = q0 - q1, p0 - p1
        s = q * q + p * p
        raw, t = opacity * exp_minus(s), load(T, at)
        drawn = (s <= limit) & (t > MIN_TRANSMITTANCE)
        alpha = where(drawn, where(raw < MAX_ALPHA, raw, MAX_ALPHA), ZERO)
        w = alpha * t
        g0, g1, g2, g3 = load(state[2], at), load(state[3], at), load(state[4], at), load(state[5], at)
        shade = r * g0 + g * g1 + b * g2 + z * g3
        behind = load(S, at) - w * shade
        store(S, at, behind)
        store(T, at, t - w)
        w0, w1, w2, w3 = w0 + w * g0, w1 + w * g1, w2 + w * g2, w3 + w * g3
        # where nothing is drawn alpha is 0, and so is D
        D = where(alpha < MAX_ALPHA, alpha * (behind / (ONE - alpha)) - w * shade, ZERO)
        Dq, Dp = D * q, D * p
        m, mq, mp, mqq, mqp, mpp = m + D, mq + Dq, mp + Dp, mqq + Dq * q, mqp + Dq * p, mpp + Dp * p
    return totals((m, mq, mp, mqq, mqp, mpp, w0, w1, w2, w3))


@njit(**FAST)
def _adjoint_tile(entries: np.ndarray, splats: np.ndarray, x0: int, y0: int, state: np.ndarray,
                  sums: np.ndarray) -> None:  # fmt: skip
    """Fill the rows of one tile's entries in `sums`; `state` [6, TILE * TILE]: T, S, and g of colour (3) and depth."""
    alive = blocks_alive(state[0])
    for k in range(len(entries)):
        splat, mask = splats[entries[k, RANK]], entries[k, MASK] & alive
        prefetch(splats, WIDTH * entries[min(k + AHEAD, len(entries) - 1), RANK])
        store(sums, LANES * entries[k, SLOT], _adjoint_entry(splat, mask, x0, y0, state))
        if k % CHECK == CHECK - 1:
            alive = blocks_alive(state[0])


def composite_adjoint(splats: np.ndarray, starts: np.ndarray, entries: np.ndarray, colour: np.ndarray,
                      depth: np.ndarray, transmittance: np.ndarray, g_colour: np.ndarray, g_depth: np.ndarray,
                      g_alpha: np.ndarray) -> np.ndarray:  # fmt: skip
    """Sums [entries, LANES] over the pixels of each tile, as `_adjoint_entry` returns them; rows in the order of SLOT.

    Args:
        splats, starts, entries: as for `composite`, which returned colour, depth and transmittance.
        g_colour: [H, W, 3], g_depth: [H, W], g_alpha: [H, W], gradients of the loss by the images; alpha is
            1 - transmittance.
    """
    sums = np.empty((len(entries), LANES), np.float32)
    images = colour, depth, transmittance, g_colour, g_depth, g_alpha
    spread(_composite_adjoint, len(starts) - 1, splats, starts, entries, *images, sums)
    return sums


@njit(**FAST)
def _composite_adjoint(first: int, last: int, splats: np.ndarray, starts: np.ndarray, entries: np.ndarray,
                       colour: np.ndarray, depth: np.ndarray, transmittance: np.ndarray, g_colour: np.ndarray,
                       g_depth: np.ndarray, g_alpha: np.ndarray, sums: np.ndarray) -> None:  # fmt: skip
    height, width = transmittance.shape
    columns = (width + TILE - 1) // TILE
    state = np.empty((6, TILE * TILE), np.float32)
    for tile in range(first, last):
        y0, x0 = tile // columns * TILE, tile % columns * TILE
        state[:] = 0
        for y in range(y0, min(y0 + TILE, height)):
            for x in range(x0, min(x0 + TILE, width)):
                at = place(y - y0, x - x0)
                state[0, at] = ONE
                remainder = g_depth[y, x] * depth[y, x] - g_alpha[y, x] * transmittance[y, x]
                for c in range(3):
                    state[2 + c, at] = g_colour[y, x, c]
                    remainder += g_colour[y, x, c] * colour[y, x, c]
                state[1, at], state[5, at] = remainder, g_depth[y, x]
        _adjoint_tile(entries[starts[tile] : starts[tile + 1]], splats, x0, y0, state, sums)


Gradients = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def splat_gradients(order: np.ndarray, splats: np.ndarray, slots: np.ndarray, sums: np.ndarray, N: int) -> Gradients:
    """Gradients of centres [N, 2], factors [N, 3], opacities [N], colours [N, 3] and depths [N]; zero if not drawn.

    Args:
        order: [V] indices of the Gaussians drawn, as for `raster_bins.gather`, which made `splats`.
        slots: as in `Bins`. sums: of `composite_adjoint`.
    """
    centres, factors, opacities = np.zeros((N, 2), np.float32), np.zeros((N, 3), np.float32), np.zeros(N, np.float32)
    colours, depths = np.zeros((N, 3), np.float32), np.zeros(N, np.float32)
    spread(_splat_gradients, len(order), order, splats, slots, sums, centres, factors, opacities, colours, depths)
    return centres, factors, opacities, colours, depths


@njit(**FAST)
def _splat_gradients(first: int, last: int, order: np.ndarray, splats: np.ndarray, slots: np.ndarray,
                     sums: np.ndarray, centres: np.ndarray, factors: np.ndarray, opacities: np.ndarray,
                     colours: np.ndarray, depths: np.ndarray) -> None:  # fmt: skip
    m = np.empty(LANES, np.float32)
    for rank in range(first, last):
        if slots[rank] == slots[rank + 1]:
            continue
        summed = load(NOTHING, 0)
        for slot in range(slots[rank], slots[rank + 1]):
            summed = summed + load(sums, LANES * slot)
        store(m, 0, summed)
        i, f0, f1, f2 = order[rank], splats[rank, 2], splats[rank, 3], splats[rank, 4]
        centres[i, 0], centres[i, 1] = TWO * f0 * m[1], TWO * (f1 * m[1] + f2 * m[2])
        factors[i, 0] = TWO * (m[3] - f1 / f2 * m[4]) / f0
        factors[i, 1], factors[i, 2] = TWO * m[4] / f2, TWO * m[5] / f2
        opacities[i], depths[i] = -m[0] / splats[rank, 5], m[9]
        colours[i, 0], colours[i, 1], colours[i, 2] = m[6], m[7], m[8]
