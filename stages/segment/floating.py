"""Parts of movers whose flow is that of something static: they float before the scene, and hang on what is found.

The side of a tram that comes the other way moves in the image like the side of a nearer tram at rest, so nothing in its
flow tells. But nothing holds that nearer tram: at its depth as if static it lies before all that is around it, the
ground below it too, and it adjoins a mover. What stands on the ground, or reaches the border of the image, does not
float; what a mover passes adjoins it in some frames, and not in those between.
"""

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components

from stages.segment.permanence import DYNAMIC, Links, windows
from stages.segment.static_world import StaticWorld
from stages.segment.superpixels import Superpixels, borders

NEARER = 1.15
"""Ratio of inverse depths between neighbours from which on the nearer one lies before the other."""
BEFORE = 0.8
"""Share of the border with what is not found, at least, along which something that floats lies before it."""
HANGS, OPEN = 0.15, 0.15
"""Shares of its border, at least, that it has with what is found, and along which it lies before the rest: what a mover
encloses, ground between legs, is seen through it."""
LEAST, MOST = 6, 0.3
"""Superpixels of which it has at least so many: the rims of movers have the depth of what is behind them. Share of the
frame that it has at most."""
AGREE = 0.5
"""Share of what the flow matches with it in the frames around that must float, or be found, as well."""


def floating(linked: Links, world: StaticWorld, sure: np.ndarray) -> np.ndarray:
    """Which superpixels [N], bool, float before the static scene and hang on what is found, in most frames around.

    Args:
        sure: [N] of `permanence.persistent`, from DYNAMIC on what is known to move.
    """
    pixels, found = linked.pixels, sure >= DYNAMIC
    frame = np.repeat(np.arange(len(pixels.labels)), np.diff(pixels.first))
    floats = np.concatenate([_of_frame(pixels, world, found, k) for k in range(len(pixels.labels))])
    agreeing, matched = np.zeros((2, len(found)))
    for start, stop, _ in windows(len(pixels.labels)):  # links of two windows that overlap count in both
        nodes = slice(pixels.first[start], pixels.first[stop])
        if not floats[nodes].any():
            continue
        W, at = linked.within(start, stop).tocoo(), frame[nodes]
        along = np.where(at[W.row] == at[W.col], 0, W.data)  # links within a frame are borders
        matched[nodes] += np.bincount(W.row, along, len(at))
        agreeing[nodes] += np.bincount(W.row, along * (floats | found)[nodes][W.col], len(at))
    return np.asarray(floats & (matched > 0) & (agreeing >= AGREE * matched))


def _of_frame(pixels: Superpixels, world: StaticWorld, found: np.ndarray, k: int) -> np.ndarray:
    """Which superpixels [n], bool, of frame k float and hang on those that are `found` [N], bool, of all frames."""
    part, found = pixels.part(k, k + 1), found[pixels.first[k] : pixels.first[k + 1]]
    if not found.any():
        return np.zeros_like(found)
    depth = ndimage.median(world.inverse_depth(k), part.labels[0], np.arange(len(found)))
    shared = borders(part).tocoo()
    a, b, length = shared.row, shared.col, shared.data
    before = depth[a] > NEARER * depth[b]
    joined = ~found[a] & ~found[b] & ~before & ~(depth[b] > NEARER * depth[a])
    graph = sparse.coo_matrix((joined[joined], (a[joined], b[joined])), shared.shape)
    count, body = connected_components(graph, directed=False)
    outer = ~found[a] & (body[a] != body[b])
    hanging, others, behind = (
        np.bincount(body[a], length * (outer & of), count) for of in (found[b], ~found[b], ~found[b] & before)
    )
    labels = part.labels[0]
    area, pieces = np.bincount(body, part.areas, count), np.bincount(body, minlength=count)
    border = hanging + others
    floats = (hanging > HANGS * border) & (behind > OPEN * border) & (behind >= BEFORE * others)
    floats &= (pieces >= LEAST) & (area < MOST * labels.size)
    floats[body[np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])]] = False
    return np.asarray(floats[body] & ~found)
