"""Numba kernels of the rasteriser's backward pass: gradients of every splat, summed in a fixed order.

The forward pass is replayed front to back with the running remainder S = g . (what still lies behind), which starts
at g . (final pixel). So no list of contributors is stored and nothing is divided by a vanishing transmittance:
dL/dalpha = T (g . colour) - S / (1 - alpha), with alpha <= MAX_ALPHA.
"""

import numpy as np
from numba import njit, prange

from stages.gaussians.raster_kernels import (
    BOTTOM,
    CHUNKS,
    FAST,
    LIMIT,
    MAX_ALPHA,
    MAX_EXPONENT,
    MIN_ALPHA,
    MIN_TRANSMITTANCE,
    ONE,
    SPLAT,
    TILE,
    TOP,
    ZERO,
    _exp_minus,
    _misses_row,
    _opaque,
)


@njit(**FAST)
def _adjoint_tile(ranks: np.ndarray, splats: np.ndarray, x0: int, y0: int, state: np.ndarray,
                  gradients: np.ndarray) -> None:  # fmt: skip
    """Gradients [len(ranks), SPLAT] of one tile; `state` [6, TILE, TILE]: T, remainder S, g of the four channels."""
    T, S, g0, g1, g2, g3 = state[0], state[1], state[2], state[3], state[4], state[5]
    for k in range(len(ranks)):
        splat = splats[ranks[k]]
        f0, f1, f2, opacity, r, g, b, z = splat[2], splat[3], splat[4], splat[5], splat[6], splat[7], splat[8], splat[9]
        limit, left = splat[LIMIT] + np.float32(1e-3), splat[0] - np.float32(x0)
        m0 = m1 = m2 = n0 = n1 = n2 = w0 = w1 = w2 = w3 = ZERO
        for y in range(max(int(splat[TOP]) - y0, 0), min(int(splat[BOTTOM]) - y0, TILE - 1) + 1):
            dy = splat[1] - np.float32(y0 + y)
            offset, rest = f1 * dy, f2 * dy * f2 * dy
            if _misses_row(f0, offset, rest, left, limit):
                continue
            s0 = s1 = s2 = ZERO
            for x in range(TILE):
                dx = left - np.float32(x)
                q = f0 * dx + offset
                raw = opacity * _exp_minus(min(q * q + rest, MAX_EXPONENT))
                alpha, t = min(MAX_ALPHA, raw), T[y, x]
                alpha = alpha if (alpha >= MIN_ALPHA) & (t > MIN_TRANSMITTANCE) else ZERO
                w = alpha * t
                shade = r * g0[y, x] + g * g1[y, x] + b * g2[y, x] + z * g3[y, x]
                behind = S[y, x] - w * shade
                S[y, x], T[y, x] = behind, t - w
                d_alpha = t * shade - behind / (ONE - alpha)
                d_s = -raw * d_alpha if (alpha > ZERO) & (raw < MAX_ALPHA) else ZERO
                w0, w1, w2, w3 = w0 + w * g0[y, x], w1 + w * g1[y, x], w2 + w * g2[y, x], w3 + w * g3[y, x]
                s0, s1, s2 = s0 + d_s, s1 + d_s * q, s2 + d_s * q * dx
            m0, m1, m2 = m0 + s0, m1 + s1, m2 + s2
            n0, n1, n2 = n0 + s0 * dy, n1 + s1 * dy, n2 + s0 * dy * dy
        row = gradients[k]
        row[0], row[1] = 2 * f0 * m1, 2 * f1 * m1 + 2 * f2 * f2 * n0
        row[2], row[3], row[4], row[5] = 2 * m2, 2 * n1, 2 * f2 * n2, -m0 / opacity
        row[6], row[7], row[8], row[9] = w0, w1, w2, w3
        if k % 16 == 15 and _opaque(T):
            gradients[k + 1 :] = ZERO
            break


@njit(parallel=True, **FAST)
def composite_adjoint(splats: np.ndarray, starts: np.ndarray, ranks: np.ndarray, image: np.ndarray,
                      transmittance: np.ndarray, g_image: np.ndarray, g_alpha: np.ndarray) -> np.ndarray:  # fmt: skip
    """Gradients [len(ranks), SPLAT] of every listed splat, from those of image [H, W, 4] and alpha [H, W]."""
    height, width = transmittance.shape
    columns = (width + TILE - 1) // TILE
    gradients = np.empty((len(ranks), SPLAT), np.float32)
    for tile in prange((len(starts) - 1) // CHUNKS):
        y0, x0 = tile // columns * TILE, tile % columns * TILE
        state = np.zeros((6, TILE, TILE), np.float32)
        state[0] = ONE
        for y in range(min(TILE, height - y0)):
            for x in range(min(TILE, width - x0)):
                remainder = -g_alpha[y0 + y, x0 + x] * transmittance[y0 + y, x0 + x]
                for c in range(4):
                    state[2 + c, y, x] = g_image[y0 + y, x0 + x, c]
                    remainder += g_image[y0 + y, x0 + x, c] * image[y0 + y, x0 + x, c]
                state[1, y, x] = remainder
        first, last = starts[tile * CHUNKS], starts[tile * CHUNKS + CHUNKS]
        _adjoint_tile(ranks[first:last], splats, x0, y0, state, gradients[first:last])
    return gradients


@njit(parallel=True, **FAST)
def scatter(order: np.ndarray, starts: np.ndarray, ranks: np.ndarray, gradients: np.ndarray, N: int) -> np.ndarray:
    """Sum the per-tile gradients of each splat into its Gaussian: [N, SPLAT], zero for Gaussians that were not drawn.

    Chunks hold disjoint ranks, so they run in parallel and each sums its tiles in order.
    """
    total = np.zeros((N, SPLAT), np.float32)
    for chunk in prange(CHUNKS):
        for tile in range((len(starts) - 1) // CHUNKS):
            for k in range(starts[tile * CHUNKS + chunk], starts[tile * CHUNKS + chunk + 1]):
                i = order[ranks[k]]
                for c in range(SPLAT):
                    total[i, c] += gradients[k, c]
    return total
