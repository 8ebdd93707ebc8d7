"""A bounding-volume hierarchy over triangles, which answers two queries: the nearest hit, and whether there is any hit.

The tree is complete and implicit: node i has children 2i and 2i + 1, and each leaf holds LEAF triangles. Rays traverse
it without a stack and visit the nearer child first, which the split axis and the sign of the ray's direction decide.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

LEAF = 4
FAST = {"nnan", "nsz", "contract"}
"""NaN does not occur: infinities are never multiplied by 0 (see `_slope`), and a zero determinant returns early."""
EDGE = 1e-9
"""Barycentric tolerance: neighbouring triangles overlap by this much, so that no ray passes between them."""


class Tree(NamedTuple):
    """Triangles in leaf order.

    Attributes:
        low, high: [2 L, 3] corners of the box of each node; row 0 is unused.
        axis: [2 L] axis along which the node's children are ordered.
        corners: [L * LEAF, 3, 3] triangle corners.
        faces: [L * LEAF] index of each triangle in the caller's list (padding repeats one).
    """

    low: np.ndarray
    high: np.ndarray
    axis: np.ndarray
    corners: np.ndarray
    faces: np.ndarray


def build(corners: np.ndarray, faces: np.ndarray) -> Tree:
    """A tree over triangles `corners` [n, 3, 3] with indices `faces` [n].

    n is a multiple of LEAF, or 0. Each group of LEAF consecutive triangles forms a leaf, so these should be neighbours.
    Each level splits the leaves of every node at the median of their centres along the longest axis.
    """
    if len(faces) == 0:
        nowhere = np.full((2, 3), np.inf)  # not inverted corners: the slab test orders the corners and would pass them
        return Tree(nowhere, nowhere, np.zeros(2, np.int8), np.zeros((0, 3, 3)), faces)
    centres = corners.reshape(-1, LEAF * 3, 3).mean(axis=1)
    levels = int(np.ceil(np.log2(len(centres))))
    order = np.resize(np.arange(len(centres)), 1 << levels)[None]
    axis = np.zeros(2 << levels, np.int8)
    for level in range(levels):
        points = centres[order]
        longest = np.ptp(points, axis=1).argmax(axis=1)
        axis[1 << level : 2 << level] = longest
        along = np.take_along_axis(points, longest[:, None, None], axis=2)[..., 0]
        ranked = np.take_along_axis(order, along.argsort(axis=1, kind="stable"), axis=1)
        order = ranked.reshape(2 << level, -1)
    leaves = corners.reshape(-1, LEAF, 3, 3)[order.ravel()].reshape(-1, 3, 3)
    return Tree(*_boxes(leaves, levels), axis, leaves, faces.reshape(-1, LEAF)[order.ravel()].ravel())


def _boxes(corners: np.ndarray, levels: int) -> tuple[np.ndarray, np.ndarray]:
    low, high = np.zeros((2 << levels, 3)), np.zeros((2 << levels, 3))
    low[1 << levels :] = corners.reshape(-1, LEAF * 3, 3).min(axis=1)
    high[1 << levels :] = corners.reshape(-1, LEAF * 3, 3).max(axis=1)
    for level in reversed(range(levels)):
        children = slice(2 << level, 4 << level)
        low[1 << level : 2 << level] = low[children].reshape(-1, 2, 3).min(axis=1)
        high[1 << level : 2 << level] = high[children].reshape(-1, 2, 3).max(axis=1)
    return low, high


@njit(cache=True, error_model="numpy", inline="always", fastmath=FAST)
def _enters(
    low: np.ndarray,
    high: np.ndarray,
    node: int,
    ox: float,
    oy: float,
    oz: float,
    ix: float,
    iy: float,
    iz: float,
    reach: float,
) -> bool:
    """Whether the ray enters the node's box before `reach` (slab test)."""
    x0, x1 = (low[node, 0] - ox) * ix, (high[node, 0] - ox) * ix
    y0, y1 = (low[node, 1] - oy) * iy, (high[node, 1] - oy) * iy
    z0, z1 = (low[node, 2] - oz) * iz, (high[node, 2] - oz) * iz
    near = max(max(min(x0, x1), min(y0, y1)), max(min(z0, z1), 0.0))
    far = min(min(max(x0, x1), max(y0, y1)), min(max(z0, z1), reach))
    return near <= far


@njit(cache=True, error_model="numpy", inline="always", fastmath=FAST)
def _meets(
    corners: np.ndarray, k: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> tuple[float, float, float]:
    """Ray parameter t and barycentric coordinates u, v of the hit of triangle k, t = -1 for a miss.

    Moeller and Trumbore 1997.
    """
    ax, ay, az = corners[k, 0, 0], corners[k, 0, 1], corners[k, 0, 2]
    ex, ey, ez = corners[k, 1, 0] - ax, corners[k, 1, 1] - ay, corners[k, 1, 2] - az
    fx, fy, fz = corners[k, 2, 0] - ax, corners[k, 2, 1] - ay, corners[k, 2, 2] - az
    px, py, pz = dy * fz - dz * fy, dz * fx - dx * fz, dx * fy - dy * fx
    det = ex * px + ey * py + ez * pz
    if det == 0.0:
        return -1.0, 0.0, 0.0
    inverse = 1.0 / det
    sx, sy, sz = ox - ax, oy - ay, oz - az
    u = (sx * px + sy * py + sz * pz) * inverse
    if u < -EDGE or u > 1.0 + EDGE:
        return -1.0, u, 0.0
    qx, qy, qz = sy * ez - sz * ey, sz * ex - sx * ez, sx * ey - sy * ex
    v = (dx * qx + dy * qy + dz * qz) * inverse
    if v < -EDGE or u + v > 1.0 + EDGE:
        return -1.0, u, v
    return (fx * qx + fy * qy + fz * qz) * inverse, u, v


@njit(cache=True, error_model="numpy", inline="always", fastmath=FAST)
def _slope(x: float) -> float:
    """1 / x, but large instead of infinite at 0, so that the slab test never multiplies 0 by infinity."""
    return 1.0 / x if abs(x) > 1e-200 else 1e200


@njit(cache=True, error_model="numpy", fastmath=FAST)
def walk(
    tree: Tree, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, reach: float, any_hit: bool
) -> tuple[float, int, float, float]:
    """The nearest triangle along o + t d with 1e-7 < t < reach, or with `any_hit` the first one found.

    Returns:
        t (reach for a miss), the leaf-order index of the triangle (-1 for a miss), barycentrics u, v.
    """
    low, high, axis, corners, _ = tree
    ix, iy, iz = _slope(dx), _slope(dy), _slope(dz)
    first_leaf = len(low) // 2
    hit, best_u, best_v = -1, 0.0, 0.0
    node = 1
    backwards = (dx < 0.0, dy < 0.0, dz < 0.0)
    while True:
        if _enters(low, high, node, ox, oy, oz, ix, iy, iz, reach):
            if node < first_leaf:
                node = 2 * node + (1 if backwards[axis[node]] else 0)
                continue
            begin = (node - first_leaf) * LEAF
            for k in range(begin, begin + LEAF):
                t, u, v = _meets(corners, k, ox, oy, oz, dx, dy, dz)
                if 1e-7 < t < reach:
                    reach, hit, best_u, best_v = t, k, u, v
            if any_hit and hit >= 0:
                break
        while node > 1 and (node & 1) == (0 if backwards[axis[node >> 1]] else 1):
            node >>= 1
        if node == 1:
            break
        node ^= 1
    return reach, hit, best_u, best_v
