"""Cameras to render from: a path around the estimated cameras, and the right eye in the estimated world."""

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from stages.shared import lie
from stages.shared.alignment import umeyama


def novel_path(cam_from_world: np.ndarray, times: np.ndarray, radius: float, distance: float) -> np.ndarray:
    """Cameras [n, 4, 4] at `times` [n] in 0..1 that circle once around the interpolated estimated path.

    Args:
        cam_from_world: estimated [T, 4, 4], evenly spread over 0..1.
        radius: of the circle, scene units; horizontally it leads to both sides of the path, vertically to one.
        distance: of the point on the optical axis of the path at which the cameras keep looking, scene units.
    """
    world_from_cam = lie.inverse(cam_from_world)
    knots = np.linspace(0, 1, len(cam_from_world))
    centres = CubicSpline(knots, world_from_cam[:, :3, 3], bc_type="natural")(times)
    rotations = Slerp(knots, Rotation.from_matrix(world_from_cam[:, :3, :3]))(times).as_matrix()
    angle = 2 * np.pi * times
    # The circle starts and ends on the path, so a looping video jumps only by the length of the path.
    shift = np.stack([radius * np.sin(angle), 0.5 * radius * (1 - np.cos(angle)), np.zeros_like(angle)], axis=-1)
    turn = np.stack([np.arctan2(shift[:, 1], distance), -np.arctan2(shift[:, 0], distance), np.zeros_like(angle)], -1)
    offset = lie.from_parts(lie.exp_so3(turn), shift)
    return np.asarray(lie.inverse(lie.from_parts(rotations, centres) @ offset))


def right_eye(
    cam_from_world: np.ndarray, true_left: np.ndarray, true_right: np.ndarray, rows: np.ndarray
) -> np.ndarray:
    """Right-eye cameras [n, 4, 4] in the estimated world: the true relative pose, its baseline in the estimated scale.

    Args:
        cam_from_world: estimated [T, 4, 4]. true_left: [T, 4, 4]. true_right: [n, 4, 4] of the frames `rows` [n].

    Raises:
        alignment.DegenerateError: if the centres of either path do not determine the scale.
    """
    ours, truth = (lie.inverse(cameras)[:, :3, 3] for cameras in (cam_from_world, true_left))
    scale, _, _ = umeyama(ours, truth)
    relative = true_right @ lie.inverse(true_left[rows])
    relative[:, :3, 3] /= scale
    return np.asarray(relative @ cam_from_world[rows])
