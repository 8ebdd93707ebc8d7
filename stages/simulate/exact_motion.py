"""Exact ground truth of the motion in one frame, from the surface points at its pixels."""

from dataclasses import dataclass

import numpy as np

from stages.shared import cameras
from stages.shared.lens import distort, fold
from stages.simulate.keyframes import View
from stages.simulate.raycast import SKY, Hits, blocked, follow
from stages.simulate.world import Snapshot, World

MOVED_PX = 0.01
"""A pixel is moving if its surface point moves by more than this, projected at the depth of the pixel."""
SLACK = 1e-4
"""Last share of the way from the camera to a point in which surfaces do not count as occluding it."""
NEAR_M = 1e-3
"""Points with less depth have no flow."""


@dataclass(frozen=True)
class Motion:
    """Motion of the surface points of n pixels to another frame.

    Attributes:
        flow: [n, 2] pixels; zero where `invalid`.
        occluded: [n] bool, another surface hides the point in the other frame, inside the image or outside.
        invalid: [n] bool, the point is behind the other camera, or beyond what its lens shows, and has no flow.
        moving: [n] bool, the point moves in the world, by more than MOVED_PX from frame to frame.
        mover: [n] bool, the point is `moving`, or moves by more than MOVED_PX over the whole clip.
    """

    flow: np.ndarray
    occluded: np.ndarray
    invalid: np.ndarray
    moving: np.ndarray
    mover: np.ndarray


def motion(hits: Hits, uv: np.ndarray, world: World, other: Snapshot, other_view: View, focal_px: float) -> Motion:
    """Motion of the surface points at pixels uv [n, 2] from one frame to another.

    Args:
        hits: of the pixels. other, other_view: the scene and the camera of the other frame.
        focal_px: focal length of the present camera.
    """
    points = follow(hits, world, other)
    moved = np.linalg.norm(points - hits.point, axis=1)
    pixels, depth = cameras.project(points, other_view.cam_from_world, other_view.K)
    invalid = depth < NEAR_M
    if other_view.lens is not None:
        focal, centre = other_view.K[0, 0], other_view.K[:2, 2]
        xy = (pixels - centre) / focal
        invalid |= np.linalg.norm(xy, axis=1) > fold(other_view.lens)
        pixels = focal * distort(xy, other_view.lens) + centre
    flow = np.where(invalid[:, None], 0.0, pixels - uv)
    occluded = blocked(other.still, other.moving, points, other_view.centre, False, SLACK)
    threshold_m = MOVED_PX * hits.depth / focal_px
    moving = moved > threshold_m
    return Motion(flow, occluded, invalid, moving, moving | (_reach(hits, world) > threshold_m))


def _reach(hits: Hits, world: World) -> np.ndarray:
    """How far surface points [n] get in the clip at most, metres: the weighted mean of the reach of their corners.

    No point of a triangle moves farther than that: it is a mean of the corners with constant weights.
    """
    weights = np.column_stack([1 - hits.bary.sum(axis=1), hits.bary])
    reach = np.sum(weights * world.reach[world.faces[hits.face]], axis=1)
    return np.where(hits.face == SKY, 0.0, reach)
