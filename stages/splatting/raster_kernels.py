"""Numba kernels that composite binned splats front to back, tile by tile. They are deterministic: no atomics.

The state of a tile is stored block by block. The 16 pixels of a block are contiguous and form one vector; `raster_bins`
defines splats, tiles and blocks.
"""

from typing import Any

import numpy as np
from numba import njit

from stages.shared.lanes import LANES, largest, load, prefetch, store, trailing_zeros, where
from stages.shared.threads import spread
from stages.splatting.raster_bins import BLOCK, BLOCKS, FAST, LIMIT, MASK, ONE, RANK, TILE, WIDTH, ZERO

MAX_ALPHA = np.float32(0.999)
MIN_TRANSMITTANCE = np.float32(1e-4)
"""Alpha is at most MAX_ALPHA and a pixel is done at MIN_TRANSMITTANCE, as in 3DGS and gsplat."""
MAX_EXPONENT = 5.6
"""exp(-MAX_EXPONENT) < MIN_ALPHA: splats are not drawn at larger exponents, whatever their opacity."""
EXP = tuple(
    np.polynomial.Chebyshev.interpolate(lambda s: np.exp(-s / 8), 5, domain=[0, MAX_EXPONENT])
    .convert(kind=np.polynomial.Polynomial)
    .coef.astype(np.float32)
)
"""Coefficients of a polynomial for exp(-s / 8)."""
CHECK = 16
"""Number of splats after which finished blocks are looked for."""
AHEAD = 6
"""Number of entries by which a splat is prefetched before it is drawn."""
LANE_X = (np.arange(LANES) % BLOCK).astype(np.float32)
LANE_Y = (np.arange(LANES) // BLOCK).astype(np.float32)


@njit(inline="always", **FAST)
def exp_minus(s: Any) -> Any:
    """exp(-s) for s in 0..MAX_EXPONENT, with a relative error up to 2e-6; not valid beyond."""
    p = EXP[0] + s * (EXP[1] + s * (EXP[2] + s * (EXP[3] + s * (EXP[4] + s * EXP[5]))))
    p = p * p
    p = p * p
    return p * p


@njit(inline="always", **FAST)
def block_corner(splat: np.ndarray, x0: int, y0: int) -> tuple[Any, Any]:
    """f0 dx + f1 dy and f2 dy, vectors [LANES], at the first block of the tile whose first pixel is (x0, y0)."""
    dx = splat[0] - np.float32(x0) - load(LANE_X, 0)
    dy = splat[1] - np.float32(y0) - load(LANE_Y, 0)
    return splat[2] * dx + splat[3] * dy, splat[4] * dy


@njit(inline="always", **FAST)
def block_offset(splat: np.ndarray, block: int) -> tuple[Any, Any]:
    """Differences (scalars) of both values of `block_corner` between the first block of a tile and another one."""
    x, y = np.float32(BLOCK * (block % BLOCKS)), np.float32(BLOCK * (block // BLOCKS))
    return splat[2] * x + splat[3] * y, splat[4] * y


@njit(inline="always", **FAST)
def place(y: int, x: int) -> int:
    """Index of the tile's pixel (y, x) in its state."""
    return LANES * (y // BLOCK * BLOCKS + x // BLOCK) + y % BLOCK * BLOCK + x % BLOCK


@njit(**FAST)
def blocks_alive(T: np.ndarray) -> int:
    """The bits of the blocks with a pixel above MIN_TRANSMITTANCE, from the transmittance [TILE * TILE]."""
    alive = 0
    for block in range(BLOCKS * BLOCKS):
        if largest(load(T, LANES * block)) > MIN_TRANSMITTANCE:
            alive |= 1 << block
    return alive


@njit(**FAST)
def _composite_tile(entries: np.ndarray, splats: np.ndarray, x0: int, y0: int, state: np.ndarray) -> None:
    """Composite the listed splats into `state` [5, TILE * TILE]: transmittance, red, green, blue, depth."""
    T, red, green, blue, depth = state[0], state[1], state[2], state[3], state[4]
    alive = blocks_alive(T)
    for k in range(len(entries)):
        splat, mask = splats[entries[k, RANK]], entries[k, MASK] & alive
        prefetch(splats, WIDTH * entries[min(k + AHEAD, len(entries) - 1), RANK])
        opacity, r, g, b, z, limit = splat[5], splat[6], splat[7], splat[8], splat[9], splat[LIMIT]
        q0, p0 = block_corner(splat, x0, y0)
        while mask:
            block = trailing_zeros(mask)
            mask &= mask - 1
            at = LANES * block
            q1, p1 = block_offset(splat, block)
            q, p = q0 - q1, p0 - p1
            s = q * q + p * p
            raw, t = opacity * exp_minus(s), load(T, at)
            alpha = where(raw < MAX_ALPHA, raw, MAX_ALPHA)
            w = where((s <= limit) & (t > MIN_TRANSMITTANCE), alpha, ZERO) * t
            store(red, at, load(red, at) + w * r)
            store(green, at, load(green, at) + w * g)
            store(blue, at, load(blue, at) + w * b)
            store(depth, at, load(depth, at) + w * z)
            store(T, at, t - w)
        if k % CHECK == CHECK - 1:
            alive = blocks_alive(T)
            if alive == 0:
                break


def composite(splats: np.ndarray, starts: np.ndarray, entries: np.ndarray, background: np.ndarray, height: int,
              width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Colour [H, W, 3] over `background` [3], accumulated depth [H, W] (scene units) and transmittance [H, W].

    Args:
        splats: [V, WIDTH] of `raster_bins.gather`. starts, entries: of `raster_bins.bin_tiles`.
    """
    colour, depth = np.empty((height, width, 3), np.float32), np.empty((height, width), np.float32)
    transmittance = np.empty((height, width), np.float32)
    spread(_composite, len(starts) - 1, splats, starts, entries, background, colour, depth, transmittance)
    return colour, depth, transmittance


@njit(**FAST)
def _composite(first: int, last: int, splats: np.ndarray, starts: np.ndarray, entries: np.ndarray,
               background: np.ndarray, colour: np.ndarray, depth: np.ndarray,
               transmittance: np.ndarray) -> None:  # fmt: skip
    height, width = transmittance.shape
    columns = (width + TILE - 1) // TILE
    state = np.empty((5, TILE * TILE), np.float32)
    for tile in range(first, last):
        y0, x0 = tile // columns * TILE, tile % columns * TILE
        rows, row_length = min(TILE, height - y0), min(TILE, width - x0)
        state[:] = 0  # zero transmittance outside the image: nothing is drawn there
        for y in range(rows):
            for x in range(row_length):
                state[0, place(y, x)] = ONE
        _composite_tile(entries[starts[tile] : starts[tile + 1]], splats, x0, y0, state)
        for y in range(rows):
            for x in range(row_length):
                at = place(y, x)
                T = state[0, at]
                transmittance[y0 + y, x0 + x] = T
                for c in range(3):
                    colour[y0 + y, x0 + x, c] = state[1 + c, at] + T * background[c]
                depth[y0 + y, x0 + x] = state[4, at]
