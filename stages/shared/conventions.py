"""Cameras in the conventions of other programs. docs/conventions.md compares them, a line of code for each."""

import numpy as np

from stages.shared import lie

CENTRE_PX = 0.5
"""Coordinate of the centre of the first pixel, both ways, in COLMAP, nerfstudio and gsplat; here it is 0."""
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenCV axes (x right, y down, z forward) to OpenGL's (x right, y up, z backward), and back."""


def half_integer_centres(Ks: np.ndarray) -> np.ndarray:
    """Intrinsics [..., 3, 3] in px for pixel centres at half-integers, from those for centres at integers."""
    moved = np.array(Ks, float)
    moved[..., :2, 2] += CENTRE_PX
    return moved


def integer_centres(Ks: np.ndarray) -> np.ndarray:
    """Intrinsics [..., 3, 3] in px for pixel centres at integers; undoes `half_integer_centres`."""
    moved = np.array(Ks, float)
    moved[..., :2, 2] -= CENTRE_PX
    return moved


def world_from_opengl(cam_from_world: np.ndarray) -> np.ndarray:
    """Poses [..., 4, 4] of OpenGL cameras in the same world, camera-to-world, from cam_from_world [..., 4, 4]."""
    return np.asarray(lie.inverse(cam_from_world) @ FLIP)


def from_opengl(world_from_opengl: np.ndarray) -> np.ndarray:
    """cam_from_world [..., 4, 4] from the poses of OpenGL cameras, camera-to-world; undoes `world_from_opengl`."""
    return lie.inverse(world_from_opengl @ FLIP)
