"""Static 3-D points with tracks, from depth: every measured pixel of the depth grid that no earlier point shows."""

from dataclasses import dataclass

import cv2
import numpy as np

from stages.shared.cameras import frame_from_grid, grid_from_frame, pixel_grid, project, unproject

DEPTH_TOLERANCE = 0.05
"""Relative difference of depth up to which a frame shows a point."""
MAX_RELATIVE_SIGMA = 0.1
"""Largest standard deviation of an inverse depth that becomes a point, as a share of it."""
MIN_TRACK = 2
"""Least number of frames that show a point."""


@dataclass(frozen=True)
class DepthGrid:
    """Depth of T frames on the grid of the adjustment.

    Attributes:
        inverse_depth: [T, h, w] in 1 / scene units. usable: [T, h, w] bool, true where it is measured and static.
        colours: [T, h, w, 3] uint8. stride_px: frame pixels per grid pixel, as in `frame_from_grid`.
        cam_from_world: [T, 4, 4]. Ks: [T, 3, 3] px.
    """

    inverse_depth: np.ndarray
    usable: np.ndarray
    colours: np.ndarray
    stride_px: float
    cam_from_world: np.ndarray
    Ks: np.ndarray


@dataclass(frozen=True)
class Points:
    """N points and the M observations that are their tracks.

    Attributes:
        xyz: [N, 3] world, scene units. rgb: [N, 3] uint8.
        error_px: [N] mean distance, in the frame that a point is from, between its pixel and the surfaces that the
            other frames of its track have at their observations.
        frame: [M] index of the frame, ascending. point: [M] index of the point. uv: [M, 2] px, centres at integers.
    """

    xyz: np.ndarray
    rgb: np.ndarray
    error_px: np.ndarray
    frame: np.ndarray
    point: np.ndarray
    uv: np.ndarray


def measured(inverse_depth: np.ndarray, variance: np.ndarray, filled: np.ndarray) -> np.ndarray:
    """Where inverse depths [...] are triangulated, not filled in, and known to MAX_RELATIVE_SIGMA: [...] bool."""
    return (filled == 0) & (np.sqrt(variance) < MAX_RELATIVE_SIGMA * inverse_depth)


def find_points(grid: DepthGrid) -> Points:
    """Points that at least MIN_TRACK frames show at the same depth.

    Each frame in turn adds the usable pixels of its grid that show no point of the frames before.
    """
    uv, source = _grid_pixels(grid), np.zeros(0, int)
    xyz, own, rgb = np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 3), np.uint8)
    for k in range(len(grid.usable)):
        new = grid.usable[k] & ~_covered(grid, k, xyz)
        depth = 1 / grid.inverse_depth[k][new].astype(float)
        xyz = np.concatenate([xyz, unproject(uv[new], depth, grid.cam_from_world[k], grid.Ks[k])])
        source, own = np.concatenate([source, np.full(len(depth), k)]), np.concatenate([own, uv[new]])
        rgb = np.concatenate([rgb, grid.colours[k][new]])
    seen = [_observe(grid, k, xyz) for k in range(len(grid.usable))]
    frame = np.repeat(np.arange(len(seen)), [len(rows) for rows, _, _ in seen])
    point, at = (np.concatenate([part[i] for part in seen]) if seen else np.zeros(0, int) for i in (0, 1))
    error = _errors(grid, seen, xyz, source, own)
    return _long_tracks(Points(xyz, rgb, error, frame, point, at.reshape(-1, 2)))


def _grid_pixels(grid: DepthGrid) -> np.ndarray:
    """Frame pixels [h, w, 2] of the grid."""
    return frame_from_grid(pixel_grid(*grid.usable.shape[1:]), grid.stride_px)


def _covered(grid: DepthGrid, k: int, xyz: np.ndarray) -> np.ndarray:
    """Pixels [h, w] of the grid of frame k that show a point, or whose neighbours do."""
    hit = np.zeros(grid.usable.shape[1:], np.uint8)
    cells = _observe(grid, k, xyz)[2]
    hit[cells[:, 1], cells[:, 0]] = 1
    return cv2.dilate(hit, np.ones((3, 3), np.uint8)) > 0


def _observe(grid: DepthGrid, k: int, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The points [n, 3] that frame k shows: rows [m], pixels [m, 2] px and cells (column, row) [m, 2] of its grid."""
    pose, height, width = grid.cam_from_world[k], *grid.usable.shape[1:]
    rows = np.flatnonzero(xyz @ pose[2, :3] + pose[2, 3] > 0)
    uv, z = project(xyz[rows], pose, grid.Ks[k])
    cells = np.rint(grid_from_frame(uv, grid.stride_px))
    inside = ((cells >= 0) & (cells < (width, height))).all(axis=-1)
    rows, uv, z, cells = rows[inside], uv[inside], z[inside], cells[inside].astype(int)
    at = (k, cells[:, 1], cells[:, 0])
    shown = grid.usable[at] & (np.abs(z * grid.inverse_depth[at] - 1) < DEPTH_TOLERANCE)
    return rows[shown], uv[shown], cells[shown]


def _errors(
    grid: DepthGrid,
    seen: list[tuple[np.ndarray, np.ndarray, np.ndarray]],
    xyz: np.ndarray,
    source: np.ndarray,
    own: np.ndarray,
) -> np.ndarray:
    """`Points.error_px` [n] of points from the frames `source` [n] and their pixels `own` [n, 2]."""
    total, count = np.zeros(len(xyz)), np.zeros(len(xyz))
    for k, (rows, uv, cells) in enumerate(seen):
        depth = 1 / grid.inverse_depth[k, cells[:, 1], cells[:, 0]].astype(float)
        surface = unproject(uv, depth, grid.cam_from_world[k], grid.Ks[k])
        for j in np.unique(source[rows]):
            mine = (source[rows] == j) & (j != k)
            there, _ = project(surface[mine], grid.cam_from_world[j], grid.Ks[j])
            total[rows[mine]] += np.linalg.norm(there - own[rows[mine]], axis=-1)
            count[rows[mine]] += 1
    return total / np.maximum(count, 1)


def _long_tracks(points: Points) -> Points:
    """The points with at least MIN_TRACK observations."""
    keep = np.bincount(points.point, minlength=len(points.xyz)) >= MIN_TRACK
    index, kept = np.cumsum(keep) - 1, keep[points.point]
    return Points(
        points.xyz[keep],
        points.rgb[keep],
        points.error_px[keep],
        points.frame[kept],
        index[points.point[kept]],
        points.uv[kept],
    )
