"""Numba kernel of the votes of one frame on points: numpy takes ten passes over the points of every frame."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def vote(
    first: int,
    last: int,
    positions: np.ndarray,
    cam_from_world: np.ndarray,
    K: np.ndarray,
    depth: np.ndarray,
    votes: np.ndarray,
    nearness: float,
    at_surface: bool,
    views: np.ndarray,
    count: np.ndarray,
) -> None:
    """Count a frame for points first..last - 1: in views [n] where it shows them, in count [n] where it votes for them.

    Args:
        positions: [n, 3] float64. depth: [H, W], -inf where nothing is visible. votes: [H, W] bool.
        nearness: ratio of depths up to which two points count as the same surface.
        at_surface: only votes on points that are not in front of the surface count.
    """
    H, W = depth.shape
    R, t = cam_from_world[:3, :3], cam_from_world[:3, 3]
    for i in range(first, last):
        x, y, z = positions[i]
        depth_of_point = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
        if not depth_of_point > 0:
            continue
        right = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]
        down = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]
        u = (K[0, 0] * right + K[0, 1] * down) / depth_of_point + K[0, 2]
        v = K[1, 1] * down / depth_of_point + K[1, 2]
        if not (-0.5 < u < W - 0.5 and -0.5 < v < H - 0.5):
            continue
        row, column = int(np.rint(v)), int(np.rint(u))
        surface = depth[row, column]
        if not depth_of_point < surface * nearness:
            continue
        views[i] += 1
        if votes[row, column] and (not at_surface or surface < depth_of_point * nearness):
            count[i] += 1
