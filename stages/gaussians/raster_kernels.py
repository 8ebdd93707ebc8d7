"""Numba kernels that composite sorted splats front to back over tiles, and the adjoint. Deterministic: no atomics.

A splat is a row of SPLAT floats: centre (px), factor, opacity, colour, depth. The factor (f0, f1, f2) is the Cholesky
factor of half the inverse 2-D covariance, so that the exponent is a sum of squares: with (dx, dy) = centre - pixel,
s = (f0 dx + f1 dy)^2 + (f2 dy)^2 and alpha = opacity exp(-s). The usual A dx^2 + 2 B dx dy + C dy^2 cancels for
needle-shaped splats; this form cannot, at the same cost.
"""

import math
from typing import Any

import numpy as np
from numba import njit, prange

TILE = 16
"""Tile side in pixels: one row of a tile is one AVX-512 register of float32."""
CHUNKS = 8
"""Splats are binned and gradients summed in this many parts: fixed, so results do not depend on the thread count."""
SPLAT = 10
"""Columns of a splat that carry gradients: x, y, f0, f1, f2, opacity, red, green, blue, depth."""
LIMIT, TOP, BOTTOM = 10, 11, 12
"""Further columns: the exponent at which alpha is MIN_ALPHA, and the first and last pixel row within reach."""
MIN_ALPHA = np.float32(1 / 255)
MAX_ALPHA = np.float32(0.999)
MIN_TRANSMITTANCE = np.float32(1e-4)
"""Contributions below MIN_ALPHA are dropped and a pixel is done at MIN_TRANSMITTANCE, as in 3DGS and gsplat."""
MAX_EXPONENT = np.float32(7)
"""exp(-7) < MIN_ALPHA: larger exponents need no accurate exponential."""

FAST = {"cache": True, "fastmath": True, "error_model": "numpy"}
ONE, ZERO = np.float32(1), np.float32(0)


@njit(**FAST)
def _exp_minus(s: Any) -> Any:
    """exp(-s) for s in 0..7 within 1e-4 relative: Taylor of exp(-s / 16), squared four times; vectorises."""
    x = s * np.float32(-1 / 16)
    p = ONE + x * (
        ONE + x * (np.float32(1 / 2) + x * (np.float32(1 / 6) + x * (np.float32(1 / 24) + x / np.float32(120))))
    )
    p *= p
    p *= p
    p *= p
    return p * p


@njit(**FAST)
def _set_reach(splat: np.ndarray, height: int) -> None:
    """Fill the columns LIMIT, TOP and BOTTOM (TOP > BOTTOM if no pixel row is reached)."""
    limit = math.log(255.0 * max(splat[5], 1e-12))
    reach = math.sqrt(max(limit, 0.0)) / splat[4]
    splat[LIMIT] = limit
    splat[TOP] = max(math.ceil(splat[1] - reach), 0.0)
    splat[BOTTOM] = min(math.floor(splat[1] + reach), height - 1.0) if limit > 0 else -1.0


@njit(**FAST)
def _tile_range(splat: np.ndarray, top: int, bottom: int, width: int) -> tuple[int, int]:
    """First and last tile column that the splat's ellipse reaches within the pixel rows top..bottom.

    The ellipse is |f0 dx + f1 dy| <= sqrt(limit - (f2 dy)^2); its right edge is concave in dy with the
    maximum at dy = -(f1 / f2) sqrt(limit / (f1^2 + f2^2)) and its left edge is the mirror image.
    """
    f0, f1, f2, limit = splat[2], splat[3], splat[4], splat[LIMIT]
    summit = f1 / f2 * math.sqrt(limit / (f1 * f1 + f2 * f2))
    low, high = splat[1] - bottom, splat[1] - top
    right_dy = min(max(summit, low), high)
    left_dy = min(max(-summit, low), high)
    right = splat[0] + (math.sqrt(max(limit - (f2 * right_dy) ** 2, 0.0)) + f1 * right_dy) / f0
    left = splat[0] + (-math.sqrt(max(limit - (f2 * left_dy) ** 2, 0.0)) + f1 * left_dy) / f0
    first, last = max(math.ceil(left), 0.0), min(math.floor(right), width - 1.0)
    if last < first:
        return 1, 0
    return int(first) // TILE, int(last) // TILE


@njit(parallel=True, **FAST)
def gather(order: np.ndarray, centres: np.ndarray, factors: np.ndarray, opacities: np.ndarray, colours: np.ndarray,
           depths: np.ndarray, height: int) -> np.ndarray:  # fmt: skip
    """Splats [V, SPLAT + 3] in the order [V] of drawing."""
    splats = np.empty((len(order), SPLAT + 3), np.float32)
    for rank in prange(len(order)):
        i = order[rank]
        splats[rank, 0], splats[rank, 1] = centres[i, 0], centres[i, 1]
        splats[rank, 2], splats[rank, 3], splats[rank, 4] = factors[i, 0], factors[i, 1], factors[i, 2]
        splats[rank, 5] = opacities[i]
        splats[rank, 6], splats[rank, 7], splats[rank, 8] = colours[i, 0], colours[i, 1], colours[i, 2]
        splats[rank, 9] = depths[i]
        _set_reach(splats[rank], height)
    return splats


@njit(parallel=True, **FAST)
def bin_tiles(splats: np.ndarray, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """List the splats of every tile, front to back: a counting sort over CHUNKS runs of ranks.

    Returns:
        starts [tiles * CHUNKS + 1]: where each tile's share of each chunk begins; ranks [starts[-1]].
    """
    columns, rows = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    counts = np.zeros((CHUNKS, columns * rows), np.int64)
    for chunk in prange(CHUNKS):
        _visit(splats, chunk, width, counts[chunk], np.empty(0, np.int32))
    starts = np.zeros(columns * rows * CHUNKS + 1, np.int64)
    starts[1:] = np.cumsum(counts.T.copy().ravel())
    ranks = np.empty(starts[-1], np.int32)
    cursors = starts[:-1].reshape(-1, CHUNKS).T.copy()
    for chunk in prange(CHUNKS):
        _visit(splats, chunk, width, cursors[chunk], ranks)
    return starts, ranks


@njit(**FAST)
def _visit(splats: np.ndarray, chunk: int, width: int, cursors: np.ndarray, ranks: np.ndarray) -> None:
    """Advance the cursor of every tile that a chunk's splats reach; store the rank there unless only counting."""
    columns = (width + TILE - 1) // TILE
    V = len(splats)
    for rank in range(chunk * V // CHUNKS, (chunk + 1) * V // CHUNKS):
        top, bottom = int(splats[rank, TOP]), int(splats[rank, BOTTOM])
        for row in range(top // TILE, bottom // TILE + 1):
            strip_top, strip_bottom = max(top, row * TILE), min(bottom, row * TILE + TILE - 1)
            first, last = _tile_range(splats[rank], strip_top, strip_bottom, width)
            for tile in range(row * columns + first, row * columns + last + 1):
                if len(ranks) > 0:
                    ranks[cursors[tile]] = rank
                cursors[tile] += 1


@njit(**FAST)
def _misses_row(f0: Any, offset: Any, rest: Any, left: Any, limit: Any) -> Any:
    """Whether (f0 dx + offset)^2 + rest > limit for all pixels of a tile row; dx runs from left down to left - 15."""
    high = f0 * left + offset
    low = high - f0 * np.float32(TILE - 1)
    nearest = max(ZERO, max(low, -high))
    return nearest * nearest + rest > limit


@njit(**FAST)
def _composite_tile(ranks: np.ndarray, splats: np.ndarray, x0: int, y0: int, state: np.ndarray) -> None:
    """Draw the ranked splats into `state` [5, TILE, TILE]: transmittance, red, green, blue, depth."""
    T, red, green, blue, depth = state[0], state[1], state[2], state[3], state[4]
    for k in range(len(ranks)):
        splat = splats[ranks[k]]
        f0, f1, f2, opacity = splat[2], splat[3], splat[4], splat[5]
        r, g, b, z = splat[6], splat[7], splat[8], splat[9]
        limit, left = splat[LIMIT] + np.float32(1e-3), splat[0] - np.float32(x0)
        for y in range(max(int(splat[TOP]) - y0, 0), min(int(splat[BOTTOM]) - y0, TILE - 1) + 1):
            dy = splat[1] - np.float32(y0 + y)
            offset, rest = f1 * dy, f2 * dy * f2 * dy
            if _misses_row(f0, offset, rest, left, limit):
                continue
            for x in range(TILE):
                q = f0 * (left - np.float32(x)) + offset
                alpha = min(MAX_ALPHA, opacity * _exp_minus(min(q * q + rest, MAX_EXPONENT)))
                t = T[y, x]
                alpha = alpha if (alpha >= MIN_ALPHA) & (t > MIN_TRANSMITTANCE) else ZERO
                w = alpha * t
                red[y, x] += w * r
                green[y, x] += w * g
                blue[y, x] += w * b
                depth[y, x] += w * z
                T[y, x] = t - w
        if k % 16 == 15 and _opaque(T):
            break


@njit(**FAST)
def _opaque(T: np.ndarray) -> Any:
    largest = ZERO
    for y in range(TILE):
        for x in range(TILE):
            largest = max(largest, T[y, x])
    return largest <= MIN_TRANSMITTANCE


@njit(parallel=True, **FAST)
def composite(splats: np.ndarray, starts: np.ndarray, ranks: np.ndarray, background: np.ndarray, image: np.ndarray,
              transmittance: np.ndarray) -> None:  # fmt: skip
    """Fill image [H, W, 4] (red, green, blue over `background` [3], accumulated depth) and transmittance [H, W]."""
    height, width = transmittance.shape
    columns = (width + TILE - 1) // TILE
    for tile in prange((len(starts) - 1) // CHUNKS):
        y0, x0 = tile // columns * TILE, tile % columns * TILE
        state = np.zeros((5, TILE, TILE), np.float32)
        state[0] = ONE
        _composite_tile(ranks[starts[tile * CHUNKS] : starts[tile * CHUNKS + CHUNKS]], splats, x0, y0, state)
        for y in range(min(TILE, height - y0)):
            for x in range(min(TILE, width - x0)):
                T = state[0, y, x]
                transmittance[y0 + y, x0 + x] = T
                for c in range(3):
                    image[y0 + y, x0 + x, c] = state[1 + c, y, x] + T * background[c]
                image[y0 + y, x0 + x, 3] = state[4, y, x]
