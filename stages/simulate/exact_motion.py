"""Exact truth of one frame from the surface points that its pixels see."""

from dataclasses import dataclass

import numpy as np

from stages.shared import cameras
from stages.simulate.keyframes import View
from stages.simulate.raycast import Hits, blocked, follow
from stages.simulate.world import Snapshot, World

MOVED_PX = 0.01
"""A pixel is in motion if its surface point moves by more than this, as seen at its depth."""
SLACK = 1e-4
"""Share of the way to a point, next to it, on which a surface does not count as occluding it."""
NEAR_M = 1e-3


@dataclass(frozen=True)
class Motion:
    """How the surface points of n pixels move to another frame.

    Attributes:
        flow: [n, 2] pixels; zero where `invalid`.
        occluded: [n] something else hides the point in the other frame (inside the picture or not).
        invalid: [n] the point is behind the other camera: it has no flow.
        moving: [n] the point itself moves in the world.
    """

    flow: np.ndarray
    occluded: np.ndarray
    invalid: np.ndarray
    moving: np.ndarray


def motion(hits: Hits, uv: np.ndarray, world: World, other: Snapshot, other_view: View, focal_px: float) -> Motion:
    """Motion of what pixels [n, 2] see to another moment, seen from its camera."""
    points = follow(hits, world, other)
    moved = np.linalg.norm(points - hits.point, axis=1)
    pixels, depth = cameras.project(points, other_view.cam_from_world, other_view.K)
    invalid = depth < NEAR_M
    flow = np.where(invalid[:, None], 0.0, pixels - uv)
    occluded = blocked(other.still, other.moving, points, other_view.centre, False, SLACK)
    return Motion(flow, occluded, invalid, moved * focal_px > MOVED_PX * hits.depth)
