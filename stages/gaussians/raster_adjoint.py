"""Numba kernels of the rasteriser's backward pass: gradients of every splat, summed in a fixed order.

The forward pass is replayed front to back with the running remainder S = g . (what still lies behind), which starts
at g . (final pixel). So no list of contributors is stored and nothing is divided by a vanishing transmittance:
dL/dalpha = T (g . colour) - S / (1 - alpha), with alpha <= MAX_ALPHA.

With q = f0 dx + f1 dy, p = f2 dy and D = dL/ds, the splat's gradients follow from the moments of D: the sums of
D, D q, D p, D q^2, D q p and D p^2. Both q and p are bounded where the splat is drawn, however long it is.
"""

from typing import Any

import numpy as np
from numba import njit, prange

from stages.gaussians.lanes import LANES, load, prefetch, store, totals, trailing_zeros, where
from stages.gaussians.raster_bins import CHUNKS, FAST, LIMIT, MASK, ONE, RANK, SLOT, SPLAT, TILE, WIDTH, ZERO
from stages.gaussians.raster_kernels import (
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
    """Sums over one tile: six moments of D, then the gradients of the four channels; advances the state."""
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
        D = where(drawn & (raw < MAX_ALPHA), raw * (behind / (ONE - alpha) - t * shade), ZERO)
        Dq, Dp = D * q, D * p
        m, mq, mp, mqq, mqp, mpp = m + D, mq + Dq, mp + Dp, mqq + Dq * q, mqp + Dq * p, mpp + Dp * p
    return totals((m, mq, mp, mqq, mqp, mpp, w0, w1, w2, w3))


@njit(**FAST)
def _adjoint_tile(entries: np.ndarray, splats: np.ndarray, x0: int, y0: int, state: np.ndarray,
                  sums: np.ndarray) -> None:  # fmt: skip
    """Fill the slots of one tile in `sums`; `state` [6, TILE * TILE]: T, remainder S, g of the four channels."""
    alive = blocks_alive(state[0])
    for k in range(len(entries)):
        splat, mask = splats[entries[k, RANK]], entries[k, MASK] & alive
        prefetch(splats, WIDTH * entries[min(k + AHEAD, len(entries) - 1), RANK])
        store(sums, LANES * entries[k, SLOT], _adjoint_entry(splat, mask, x0, y0, state))
        if k % CHECK == CHECK - 1:
            alive = blocks_alive(state[0])


@njit(parallel=True, **FAST)
def composite_adjoint(splats: np.ndarray, starts: np.ndarray, entries: np.ndarray, image: np.ndarray,
                      transmittance: np.ndarray, g_image: np.ndarray, g_alpha: np.ndarray) -> np.ndarray:  # fmt: skip
    """Sums [entries, LANES] over the pixels of each tile, from the gradients of image [H, W, 4] and alpha [H, W]."""
    height, width = transmittance.shape
    columns = (width + TILE - 1) // TILE
    sums = np.empty((len(entries), LANES), np.float32)
    for tile in prange(len(starts) - 1):
        y0, x0 = tile // columns * TILE, tile % columns * TILE
        state = np.zeros((6, TILE * TILE), np.float32)
        for y in range(min(TILE, height - y0)):
            for x in range(min(TILE, width - x0)):
                at = place(y, x)
                state[0, at] = ONE
                remainder = -g_alpha[y0 + y, x0 + x] * transmittance[y0 + y, x0 + x]
                for c in range(4):
                    state[2 + c, at] = g_image[y0 + y, x0 + x, c]
                    remainder += g_image[y0 + y, x0 + x, c] * image[y0 + y, x0 + x, c]
                state[1, at] = remainder
        _adjoint_tile(entries[starts[tile] : starts[tile + 1]], splats, x0, y0, state, sums)
    return sums


@njit(parallel=True, **FAST)
def splat_gradients(order: np.ndarray, splats: np.ndarray, slots: np.ndarray, sums: np.ndarray, N: int) -> np.ndarray:
    """Gradients [N, SPLAT] of the Gaussians from the sums of their tiles; zero for Gaussians that were not drawn."""
    gradients = np.zeros((N, SPLAT), np.float32)
    for chunk in prange(CHUNKS):
        m = np.empty(LANES, np.float32)
        for rank in range(chunk * len(order) // CHUNKS, (chunk + 1) * len(order) // CHUNKS):
            if slots[rank] == slots[rank + 1]:
                continue
            summed = load(NOTHING, 0)
            for slot in range(slots[rank], slots[rank + 1]):
                summed = summed + load(sums, LANES * slot)
            store(m, 0, summed)
            row, f0, f1, f2 = gradients[order[rank]], splats[rank, 2], splats[rank, 3], splats[rank, 4]
            row[0], row[1] = TWO * f0 * m[1], TWO * (f1 * m[1] + f2 * m[2])
            row[2], row[3], row[4] = TWO * (m[3] - f1 / f2 * m[4]) / f0, TWO * m[4] / f2, TWO * m[5] / f2
            row[5] = -m[0] / splats[rank, 5]
            row[6], row[7], row[8], row[9] = m[6], m[7], m[8], m[9]
    return gradients
