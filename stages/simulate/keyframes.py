"""Smooth motion from keyframes, and the cameras of a scene. `frame` is a 0-based frame index, possibly fractional."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator

from stages.shared import lie
from stages.shared.cameras import centred_intrinsics
from stages.simulate.scene import FRAMES_PER_SECOND, Handheld, Scene

Curve = Callable[[float], np.ndarray]


class View(NamedTuple):
    """One camera: K [3, 3] in pixels, cam_from_world [4, 4]; k1 and k2 [2] of its lens, None for a pinhole."""

    K: np.ndarray
    cam_from_world: np.ndarray
    lens: np.ndarray | None = None

    @property
    def centre(self) -> np.ndarray:
        """Camera centre in the world [3]."""
        return -self.cam_from_world[:3, :3].T @ self.cam_from_world[:3, 3]


def curve(times: Sequence[float], values: Sequence[Sequence[float]]) -> Curve:
    """A curve [d] over `times` [n] through `values` [n][d] without overshoot (monotone cubic); constant for n = 1."""
    if len(times) == 1:
        constant = np.asarray(values[0], float)
        return lambda _: constant
    return PchipInterpolator(np.asarray(times), np.asarray(values, float))


def rotation(turn_deg: Sequence[float] | np.ndarray) -> np.ndarray:
    """Rotation [3, 3] about x, then y, then z by angles in degrees."""
    x, y, z = (lie.exp_so3(np.deg2rad(angle) * axis) for angle, axis in zip(turn_deg, np.eye(3), strict=True))
    return z @ y @ x


def camera_path(scene: Scene, seed: int) -> Callable[[float], View]:
    """The left camera as a function of the frame index."""
    keys = scene.camera.keys
    times = [key.time for key in keys]
    path = curve(times, [[*key.eye, *key.target, key.zoom] for key in keys])
    shake = _handheld(scene.camera.handheld, seed)
    distortion = scene.camera.distortion
    lens = None if distortion is None else np.array([distortion.k1, distortion.k2])

    def view(frame: float) -> View:
        state = path(frame / (scene.frames - 1))
        moved, turned = shake(frame / FRAMES_PER_SECOND)
        R = lie.exp_so3(turned) @ _look_at(state[:3], state[3:6])
        K = centred_intrinsics(scene.camera.focal * scene.width * state[6], scene.width, scene.height)
        return View(K, lie.from_parts(R, -R @ (state[:3] + moved)), lens)

    return view


def right_of(view: View, baseline: float) -> View:
    """The camera `baseline` metres to the right."""
    shifted = view.cam_from_world.copy()
    shifted[0, 3] -= baseline
    return view._replace(cam_from_world=shifted)


def _look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """cam_from_world rotation with z towards the target and the horizon level."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def _handheld(shake: Handheld, seed: int) -> Callable[[float], tuple[np.ndarray, np.ndarray]]:
    """Offset [3] in metres and rotation vector [3] in radians over the time in seconds: sines with random phases."""
    rng = np.random.default_rng([seed, 1])
    hz = rng.uniform(0.2, 3.0, (8, 6))
    phase = rng.uniform(0, 2 * np.pi, (8, 6))
    weight = 1 / hz
    weight /= np.sqrt((weight**2).sum(axis=0) / 2)
    scale = np.repeat([shake.position, np.deg2rad(shake.rotation_deg)], 3)

    def offset(seconds: float) -> tuple[np.ndarray, np.ndarray]:
        twist = scale * (weight * np.sin(2 * np.pi * hz * seconds + phase)).sum(axis=0)
        return twist[:3], twist[3:]

    return offset
