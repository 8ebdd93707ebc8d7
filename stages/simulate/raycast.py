"""Ray casting in a snapshot: surface points at pixels of a camera, and occlusion between two points."""

from typing import NamedTuple

import numpy as np
from numba import njit

from stages.shared.lens import undistort
from stages.shared.threads import spread
from stages.simulate.bvh import Tree, walk
from stages.simulate.keyframes import View
from stages.simulate.world import Snapshot, World

DOME_M = 2000.0
"""Radius of the sky, a static sphere about the world's origin, which gives every pixel a depth and a flow."""
SKY = -1
FAR = 1e30


class Hits(NamedTuple):
    """Surface points of n rays.

    Attributes:
        depth: [n] z-depth in metres.
        face: [n] index of the triangle, or SKY.
        bary: [n, 2] barycentric weights of the triangle's second and third corner.
        point: [n, 3] in the world, metres.
    """

    depth: np.ndarray
    face: np.ndarray
    bary: np.ndarray
    point: np.ndarray


def cast(snapshot: Snapshot, view: View, uv: np.ndarray) -> Hits:
    """The nearest surface points along the rays through pixels uv [n, 2]."""
    focal, cx, cy = view.K[0, 0], view.K[0, 2], view.K[1, 2]
    xy = np.column_stack([(uv[:, 0] - cx) / focal, (uv[:, 1] - cy) / focal])
    if view.lens is not None:
        xy = undistort(xy, view.lens)
    rays = np.column_stack([xy, np.ones(len(uv))])
    directions = rays @ view.cam_from_world[:3, :3]
    depth, face, bary = _nearest(snapshot.still, snapshot.moving, view.centre, directions)
    return Hits(depth, face, bary, view.centre + depth[:, None] * directions)


def follow(hits: Hits, world: World, snapshot: Snapshot) -> np.ndarray:
    """Positions [n, 3] of the surface points of `hits` in another snapshot; the sky is at rest."""
    moved = hits.point.copy()
    spread(_follow, len(moved), world.faces, snapshot.vertices, hits.face, hits.bary, moved)
    return moved


def enclosing(world: World, snapshot: Snapshot, point: np.ndarray) -> str | None:
    """The name of a solid body that a point [3] is inside of or under, or None.

    A point is inside or under a body if the first face above it is seen from behind.
    """
    overhead = np.array([[0.013, 0.017, 1.0]])
    face = _nearest(snapshot.still, snapshot.moving, point, overhead)[1][0]
    if face == SKY or not world.bodies[world.body[face]].solid:
        return None
    a, b, c = snapshot.vertices[world.faces[face]]
    return world.bodies[world.body[face]].name if np.cross(b - a, c - a) @ overhead[0] > 0 else None


def _nearest(
    still: Tree, moving: Tree, centre: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    n = len(directions)
    depth, face, bary = np.empty(n), np.empty(n, np.int64), np.zeros((n, 2))
    spread(_find_nearest, n, still, moving, centre, directions, depth, face, bary)
    return depth, face, bary


@njit(cache=True, nogil=True, error_model="numpy")
def _find_nearest(
    first: int,
    last: int,
    still: Tree,
    moving: Tree,
    centre: np.ndarray,
    directions: np.ndarray,
    depth: np.ndarray,
    face: np.ndarray,
    bary: np.ndarray,
) -> None:
    ox, oy, oz = centre[0], centre[1], centre[2]
    for k in range(first, last):
        dx, dy, dz = directions[k, 0], directions[k, 1], directions[k, 2]
        t, hit, u, v = walk(still, ox, oy, oz, dx, dy, dz, FAR, False)
        face[k] = still.faces[hit] if hit >= 0 else SKY
        t, hit, mu, mv = walk(moving, ox, oy, oz, dx, dy, dz, t, False)
        if hit >= 0:
            face[k], u, v = moving.faces[hit], mu, mv
        if face[k] == SKY:
            half, square = ox * dx + oy * dy + oz * dz, dx * dx + dy * dy + dz * dz
            inside = DOME_M * DOME_M - ox * ox - oy * oy - oz * oz
            t = (np.sqrt(half * half + square * inside) - half) / square
        depth[k], bary[k, 0], bary[k, 1] = t, u, v


def blocked(
    still: Tree, moving: Tree, points: np.ndarray, source: np.ndarray, directional: bool, slack: float
) -> np.ndarray:
    """Whether a surface lies between points [n, 3] and `source` [3], a point, or a direction if `directional`.

    Args:
        slack: part of the way next to the point that is not tested: a share for a point source, metres for a direction.
    """
    between = np.empty(len(points), np.bool_)
    spread(_find_blocked, len(points), still, moving, points, source, directional, slack, between)
    return between


@njit(cache=True, nogil=True, error_model="numpy")
def _find_blocked(
    first: int,
    last: int,
    still: Tree,
    moving: Tree,
    points: np.ndarray,
    source: np.ndarray,
    directional: bool,
    slack: float,
    between: np.ndarray,
) -> None:
    for k in range(first, last):
        px, py, pz = points[k, 0], points[k, 1], points[k, 2]
        if directional:
            dx, dy, dz = source[0], source[1], source[2]
            ox, oy, oz, reach = px + slack * dx, py + slack * dy, pz + slack * dz, FAR
        else:
            ox, oy, oz = source[0], source[1], source[2]
            dx, dy, dz, reach = px - ox, py - oy, pz - oz, 1.0 - slack
        hit = walk(still, ox, oy, oz, dx, dy, dz, reach, True)[1]
        if hit < 0:
            hit = walk(moving, ox, oy, oz, dx, dy, dz, reach, True)[1]
        between[k] = hit >= 0


@njit(cache=True, nogil=True)
def _follow(
    first: int,
    last: int,
    faces: np.ndarray,
    vertices: np.ndarray,
    face: np.ndarray,
    bary: np.ndarray,
    moved: np.ndarray,
) -> None:
    for k in range(first, last):
        if face[k] >= 0:
            a, b, c = faces[face[k], 0], faces[face[k], 1], faces[face[k], 2]
            v, w = bary[k, 0], bary[k, 1]
            for axis in range(3):
                moved[k, axis] = (1 - v - w) * vertices[a, axis] + v * vertices[b, axis] + w * vertices[c, axis]
