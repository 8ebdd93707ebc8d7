"""Numba kernels that list, for every tile, the splats that reach its blocks, front to back.

A splat is a row of WIDTH floats: centre (px), factor, opacity, colour, depth and more. The factor (f0, f1, f2) is the
Cholesky factor of half the inverse 2-D covariance, so that the exponent is a sum of squares: with (dx, dy) = centre -
pixel, s = (f0 dx + f1 dy)^2 + (f2 dy)^2 and alpha = opacity exp(-s). The usual form A dx^2 + 2 B dx dy + C dy^2 suffers
from cancellation for very elongated splats; the sum of squares does not, at the same cost.

The unit of work is a block: its 4 x 4 pixels fill one vector. Small splats leave fewer lanes idle in square blocks than
in rows of 16 pixels.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from stages.shared.threads import spread

BLOCK = 4
"""Side of a block in pixels: its 16 pixels are the lanes of one vector."""
BLOCKS = 4
"""Blocks along the side of a tile: its 16 blocks are the bits of an entry's mask."""
TILE = BLOCK * BLOCKS
CHUNKS = 8
"""Number of parts in which splats are binned. It is fixed, so the lists do not depend on the thread count."""
LIMIT, TOP, BOTTOM, WIDTH = 10, 11, 12, 16
"""Columns of a splat after x, y, f0, f1, f2, opacity, red, green, blue, depth: the exponent at which alpha is
MIN_ALPHA, the first and the last pixel row that it reaches; then padding up to WIDTH."""
MIN_ALPHA = 1 / 255
"""Contributions with a smaller alpha are dropped, as in 3DGS and gsplat."""
MARGIN = np.float32(1e-3)
"""Added to the limit of the exponent when blocks are chosen, against rounding; pixels are tested without it."""
RANK, MASK, SLOT = 0, 1, 2
"""Columns of an entry: the splat's rank in drawing order, the bits of the blocks that it reaches, its gradient row."""

FAST = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}
ONE, ZERO = np.float32(1), np.float32(0)


class Bins(NamedTuple):
    """The splats that each tile draws, as n entries (pairs of a tile and a splat).

    Attributes:
        starts: [tiles + 1] index of the first entry of each tile. entries: [n, 3] int32, see RANK, MASK and SLOT.
        slots: [V + 1] index of the first row of each splat in the gradients, which are ordered by splat.
    """

    starts: np.ndarray
    entries: np.ndarray
    slots: np.ndarray


def gather(order: np.ndarray, height: int, centres: np.ndarray, factors: np.ndarray, opacities: np.ndarray,
           colours: np.ndarray, depths: np.ndarray) -> np.ndarray:  # fmt: skip
    """Splats [V, WIDTH] in drawing order, for an image of this height.

    Args:
        order: [V] indices of the Gaussians to draw, nearest first.
        centres: [N, 2] px. factors: [N, 3]. opacities: [N] in 0..1. colours: [N, 3]. depths: [N] scene units.
    """
    splats = np.empty((len(order), WIDTH), np.float32)
    spread(_gather, len(order), order, centres, factors, opacities, colours, depths, height, splats)
    return splats


@njit(**FAST)
def _gather(first: int, last: int, order: np.ndarray, centres: np.ndarray, factors: np.ndarray, opacities: np.ndarray,
            colours: np.ndarray, depths: np.ndarray, height: int, splats: np.ndarray) -> None:  # fmt: skip
    for rank in range(first, last):
        i = order[rank]
        splats[rank, 0], splats[rank, 1] = centres[i, 0], centres[i, 1]
        splats[rank, 2], splats[rank, 3], splats[rank, 4] = factors[i, 0], factors[i, 1], factors[i, 2]
        splats[rank, 5] = opacities[i]
        splats[rank, 6], splats[rank, 7], splats[rank, 8] = colours[i, 0], colours[i, 1], colours[i, 2]
        splats[rank, 9] = depths[i]
        _set_reach(splats[rank], height)
        for column in range(BOTTOM + 1, WIDTH):
            splats[rank, column] = ZERO


@njit(inline="always", **FAST)
def _set_reach(splat: np.ndarray, height: int) -> None:
    """Fill the columns LIMIT, TOP and BOTTOM (TOP > BOTTOM if no pixel row is reached)."""
    limit = math.log(max(splat[5], 1e-12) / MIN_ALPHA)
    reach = math.sqrt(max(limit + float(MARGIN), 0.0)) / splat[4]
    splat[LIMIT] = limit
    splat[TOP] = max(math.ceil(splat[1] - reach), 0.0)
    splat[BOTTOM] = min(math.floor(splat[1] + reach), height - 1.0) if limit > 0 else -1.0


def bin_tiles(splats: np.ndarray, width: int, height: int) -> Bins:
    """List the splats [V, WIDTH] of every tile, front to back; tiles are numbered row by row over the image.

    The pairs of tile and mask are found for CHUNKS runs of ranks, then moved to their tiles by a counting sort.
    """
    V, tiles = len(splats), ((width + TILE - 1) // TILE) * ((height + TILE - 1) // TILE)
    room, used = np.zeros(CHUNKS + 1, np.int64), np.zeros(CHUNKS + 1, np.int64)
    spread(_room, CHUNKS, splats, width, room)
    room = np.cumsum(room)
    pairs = np.empty((room[-1], 2), np.int32)  # far too long if splats are oblique needles; the rest is not touched
    counts, slots = np.zeros((CHUNKS, tiles), np.int64), np.zeros(V + 1, np.int64)
    spread(_visit, CHUNKS, splats, width, pairs, room, counts, slots, used)
    used = np.cumsum(used)
    starts = np.append(0, np.cumsum(counts.T))
    entries = np.empty((used[-1], 3), np.int32)
    cursors = starts[:-1].reshape(-1, CHUNKS).T.copy()
    spread(_sort, CHUNKS, pairs, room, used, slots, cursors, entries)
    return Bins(starts[::CHUNKS].copy(), entries, np.cumsum(slots))


@njit(**FAST)
def _sort(first: int, last: int, pairs: np.ndarray, room: np.ndarray, used: np.ndarray, slots: np.ndarray,
          cursors: np.ndarray, entries: np.ndarray) -> None:  # fmt: skip
    """Move the pairs of some chunks to the entries of their tiles."""
    V = len(slots) - 1
    for chunk in range(first, last):
        n, ahead = used[chunk], room[chunk] - used[chunk]
        for rank in range(chunk * V // CHUNKS, (chunk + 1) * V // CHUNKS):
            for _ in range(slots[rank + 1]):
                tile, mask = pairs[n + ahead, 0], pairs[n + ahead, 1]
                k = cursors[chunk, tile]
                cursors[chunk, tile] = k + 1
                entries[k, RANK], entries[k, MASK], entries[k, SLOT] = rank, mask, n
                n += 1


@njit(**FAST)
def _room(begin: int, end: int, splats: np.ndarray, width: int, room: np.ndarray) -> None:
    """Upper bound of the number of tiles that the splats of each chunk reach, from their bounding boxes."""
    V = len(splats)
    for chunk in range(begin, end):
        for rank in range(chunk * V // CHUNKS, (chunk + 1) * V // CHUNKS):
            splat = splats[rank]
            f0, f1, f2, rows = splat[2], splat[3], splat[4], int(splat[BOTTOM]) // TILE - int(splat[TOP]) // TILE + 1
            reach = math.sqrt(max(splat[LIMIT] + MARGIN, ZERO) * (f1 * f1 + f2 * f2)) / (f0 * f2)
            left, right = max(splat[0] - reach, ZERO), min(splat[0] + reach, np.float32(width - 1))
            if rows > 0 and left <= right:
                room[chunk + 1] += rows * (int(right) // TILE - int(left) // TILE + 2)


@njit(**FAST)
def _visit(begin: int, end: int, splats: np.ndarray, width: int, pairs: np.ndarray, room: np.ndarray,
           counts: np.ndarray, slots: np.ndarray, used: np.ndarray) -> None:  # fmt: skip
    """Write tile and mask of all pairs of a chunk; count the pairs by chunk and tile, by splat, and by chunk."""
    columns, V = (width + TILE - 1) // TILE, len(splats)
    strips = np.empty((BLOCKS, 2), np.int64)
    for chunk in range(begin, end):
        n = room[chunk]
        for rank in range(chunk * V // CHUNKS, (chunk + 1) * V // CHUNKS):
            before = n
            for row in range(int(splats[rank, TOP]) // TILE, int(splats[rank, BOTTOM]) // TILE + 1):
                first, last = _strip_ranges(splats[rank], row * TILE, width, strips)
                for column in range(first // BLOCKS, last // BLOCKS + 1):
                    mask = _mask(strips, column * BLOCKS)
                    if mask:
                        pairs[n, 0], pairs[n, 1] = row * columns + column, mask
                        counts[chunk, row * columns + column] += 1
                        n += 1
            slots[rank + 1] = n - before
        used[chunk + 1] = n - room[chunk]


@njit(inline="always", **FAST)
def _strip_ranges(splat: np.ndarray, y0: int, width: int, strips: np.ndarray) -> tuple[int, int]:
    """First and last block column that the ellipse reaches in each strip of blocks from pixel row y0 on.

    Fills `strips` [BLOCKS, 2] and returns the range over all strips. In an empty range the first exceeds the last.

    The ellipse is |f0 dx + f1 dy| <= sqrt(limit - (f2 dy)^2); its right edge is concave in dy with the maximum at
    dy = (f1 / f2) sqrt(limit / (f1^2 + f2^2)) and its left edge is the mirror image.
    """
    f0, f1, f2, limit = splat[2], splat[3], splat[4], splat[LIMIT] + MARGIN
    summit = f1 / f2 * math.sqrt(limit / (f1 * f1 + f2 * f2))
    first, last = width, -1
    for strip in range(BLOCKS):
        low = splat[1] - min(splat[BOTTOM], np.float32(y0 + BLOCK * strip + BLOCK - 1))
        high = splat[1] - max(splat[TOP], np.float32(y0 + BLOCK * strip))
        a, b = width, -1
        if low <= high:
            right_dy, left_dy = min(max(summit, low), high), min(max(-summit, low), high)
            right = splat[0] + (math.sqrt(max(limit - (f2 * right_dy) ** 2, ZERO)) + f1 * right_dy) / f0
            left = splat[0] + (f1 * left_dy - math.sqrt(max(limit - (f2 * left_dy) ** 2, ZERO))) / f0
            u, v = int(max(left, ZERO)), int(min(right, np.float32(width - 1)))  # truncated: ceil and floor are calls
            u += u < left
            if right >= ZERO and u <= v:
                a, b = u // BLOCK, v // BLOCK
        strips[strip, 0], strips[strip, 1] = a, b
        first, last = min(first, a), max(last, b)
    return first, last


@njit(inline="always", **FAST)
def _mask(strips: np.ndarray, first: int) -> Any:
    """The bits of the blocks that are reached in a tile whose first block column is `first`, strip by strip."""
    mask = 0
    for strip in range(BLOCKS):
        a, b = max(strips[strip, 0] - first, 0), min(strips[strip, 1] - first, BLOCKS - 1)
        if a <= b:
            mask |= ((2 << b) - (1 << a)) << (BLOCKS * strip)
    return mask
