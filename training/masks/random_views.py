"""Random cameras, and where in the world a thing has to be so that they see it."""

from typing import Any, NamedTuple

import numpy as np

from stages.simulate.keyframes import curve
from training.masks.random_looks import Rng, chance, rounded
from training.masks.random_parts import TIMES

FORMATS = ((512, 218), (512, 218), (512, 288), (320, 136), (384, 216), (416, 312), (216, 384), (240, 320))
MOVES = ("still", "turn", "walk", "dolly", "slide", "slide", "orbit", "follow", "rise")


class View(NamedTuple):
    """The camera at TIMES, without the shake of the hand.

    Attributes:
        eye: [K, 3] world, metres. axes: right, down and forward [3, K, 3], unit vectors.
        focal_px, width, height: pixels. follows: it goes along with a mover.
    """

    eye: np.ndarray
    axes: np.ndarray
    focal_px: float
    width: int
    height: int
    follows: bool

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places [K, 2] in the image, -1..1 inside it, and depths [K] of points [K, 3] at TIMES."""
        x, y, depth = np.einsum("akc,kc->ak", self.axes, points - self.eye)
        scale = 2 * self.focal_px / np.where(np.abs(depth) < 1e-3, 1e-3, depth)
        return np.stack([x * scale / self.width, y * scale / self.height], axis=1), depth

    def point(self, u: float, v: float, depth: float) -> np.ndarray:
        """The point [3] that is seen at (u, v), each -1..1 inside the image, in the middle of the clip."""
        right, down, forward = self.axes[:, len(TIMES) // 2]
        x, y = u * self.width / (2 * self.focal_px), v * self.height / (2 * self.focal_px)
        return np.asarray(self.eye[len(TIMES) // 2] + depth * (forward + x * right + y * down))


def camera(rng: Rng) -> tuple[View, dict[str, Any], dict[str, int]]:
    """A camera that looks about along +y, its entry in the scene file, and the size of the picture."""
    width, height = FORMATS[int(rng.integers(len(FORMATS)))]
    lens_deg = rng.uniform(30, 85) if width > height else rng.uniform(30, 60)
    focal = 0.5 / np.tan(np.deg2rad(lens_deg) / 2)
    move = str(rng.choice(MOVES))
    eye, target = _path(rng, move)
    times = np.linspace(0, 1, 5)
    keys = [
        {"time": float(time), "eye": rounded(a), "target": rounded(b)}
        for time, a, b in zip(times, eye, target, strict=True)
    ]
    calm = 0.3 if move in ("still", "turn") else 1.0
    shake = 0.0 if chance(rng, 0.2) else calm * 10 ** rng.uniform(-1, 0)
    hand = {"position": round(0.02 * shake, 4), "rotation_deg": round(0.5 * shake * rng.uniform(0.3, 1.5), 3)}
    both = curve(list(times), np.hstack([eye, target]).tolist())
    states = np.stack([both(float(time)) for time in TIMES])
    view = View(states[:, :3], _axes(states[:, 3:] - states[:, :3]), focal * width, width, height, move == "follow")
    return view, {"focal": round(focal, 4), "keys": keys, "handheld": hand}, {"width": width, "height": height}


def _axes(forward: np.ndarray) -> np.ndarray:
    """Right, down and forward [3, K, 3] of a camera with level horizon that looks along [K, 3]."""
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward])


def _path(rng: Rng, move: str) -> tuple[np.ndarray, np.ndarray]:
    """Eye and target [5, 3] of the camera's keyframes."""
    high = rng.uniform(2.2, 6) if chance(rng, 0.2) else rng.uniform(0.6, 1.9)
    yaw, distance = rng.uniform(-0.15, 0.15), rng.uniform(3, 12)
    pitch = -0.25 * high / distance - rng.uniform(-0.05, 0.12) - 0.06 * max(high - 2, 0)
    along = np.array([np.sin(yaw), np.cos(yaw), 0.0])
    side = np.array([np.cos(yaw), -np.sin(yaw), 0.0])
    steps = np.linspace(-0.5, 0.5, 5) + np.array([0, *rng.uniform(-0.06, 0.06, 3), 0])
    eye = np.tile([0.0, 0.0, high], (5, 1))
    target = eye + distance * (along + np.array([0, 0, pitch]))
    sign = rng.choice((-1, 1))
    far = sign * 10 ** rng.uniform(-0.9, 0.25)
    match move:
        case "turn":
            swept = sign * np.deg2rad(10 ** rng.uniform(0.3, 1.35))
            target = target + distance * np.outer(np.tan(steps * swept), side)
        case "walk" | "dolly":
            shift = np.outer(steps * (abs(far) if move == "walk" else far), along + rng.uniform(-0.3, 0.3) * side)
            bob = (0.02 * np.sin(4 * np.pi * steps + rng.uniform(0, 6)))[:, None] * [0, 0, move == "walk"]
            eye, target = eye + shift + bob, target + shift
        case "slide" | "follow":
            shift = np.outer(steps * far, side + rng.uniform(-0.2, 0.2) * along)
            eye, target = eye + shift, target + shift
        case "orbit":
            angle = steps * sign * np.deg2rad(10 ** rng.uniform(0.3, 1.4))
            around = np.outer(np.sin(angle), side) - np.outer(np.cos(angle), along)
            eye = target + distance * around - [0, 0, distance * pitch]
        case "rise":
            eye = eye + np.outer(steps * rng.uniform(0.2, 0.8) * sign, [0.0, 0.0, 1.0])
    return eye, target
