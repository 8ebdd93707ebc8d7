"""Frames of a room and of a wall, in fog and under gains per frame, with exact depth, poses and flow."""

from functools import cache

import numpy as np
from synthetic import PLANE, flow_arrays, make_scene

from stages.scene.observed import Observed
from stages.shared.cameras import pixel_grid, unproject
from stages.shared.images import DISPLAY_GAMMA

NOISE = 0.01
"""Standard deviation of the colours, 0..1."""


@cache
def room(wall: bool = False) -> tuple:
    """A room that the camera goes into, or a slanted wall that it goes to, and the flow of its neighbouring frames."""
    ahead = np.tile(np.eye(4), (8, 1, 1))
    ahead[:, [0, 2], 3] = np.linspace((0, 0), (0.35, -1), 8)
    scene = make_scene(size=(96, 160), planes=PLANE, path=ahead) if wall else make_scene(size=(96, 160))
    return scene, flow_arrays(scene, (1,))


def lit_room(
    extinction: float = 0.0,
    airlight: tuple[float, float, float] = (0.6, 0.6, 0.6),
    gains: np.ndarray | float = 1.0,
    grey: bool = False,
    wall: bool = False,
) -> Observed:
    """The room in fog of linear radiance `airlight`, with gains per frame [T, 3]."""
    scene, (source, target, flow, visible) = room(wall)
    gains = np.broadcast_to(np.asarray(gains, float), (scene.T, 3))
    rng, rgb = np.random.default_rng(0), []
    for k, (depth, pose) in enumerate(zip(scene.depth, scene.cam_from_world, strict=True)):
        points = unproject(pixel_grid(96, 160), depth, pose, scene.K)
        x, y, z = np.moveaxis(points, -1, 0)
        shade = 0.3 + 0.25 * np.sin(3 * x + z) * np.cos(4 * y + 2 * z)
        surface = shade[..., None] * (np.ones(3) if grey else np.array([1.0, 0.8, 0.6]))
        distance = np.linalg.norm(points - np.linalg.inv(pose)[:3, 3], axis=-1)[..., None]
        clear = np.exp(-extinction * distance)
        shown = gains[k] * (clear * surface + (1 - clear) * np.array(airlight)) ** (1 / DISPLAY_GAMMA)
        noise = NOISE * rng.standard_normal((*depth.shape, 1 if grey else 3))
        rgb.append(np.clip(np.rint(255 * (shown + noise)), 0, 255) / 255)
    return Observed(
        rgb=np.stack(rgb).astype(np.float32),
        dynamic=np.zeros(scene.depth.shape, bool),
        instances=np.zeros(scene.depth.shape, np.uint16),
        depth=scene.depth,
        cam_from_world=scene.cam_from_world,
        Ks=np.broadcast_to(scene.K, (scene.T, 3, 3)),
        edges=np.stack([source, target], axis=1),
        flow=flow,
        confidence=visible,
        offsets=target - source,
    )


def drift(percent: float) -> np.ndarray:
    """A gain [T, 1] that grows by so many per cent."""
    return np.exp(np.linspace(0, np.log1p(percent / 100), room()[0].T))[:, None]


def tint(share: float) -> np.ndarray:
    """Gains [T, 3] of red and blue that go opposite ways."""
    return 1 + share * np.linspace(-1, 1, room()[0].T)[:, None] * np.array([1, 0, -1])
