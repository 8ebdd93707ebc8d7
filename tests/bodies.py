"""Bodies that are seen from close by, rigid or not: the flow of their pixels to other frames, exactly."""

import numpy as np
from scipy.spatial.transform import Rotation

from stages.scene.rigid_motion import Patch

K = np.array([[320.0, 0, 96], [0, 320, 54], [0, 0, 1]])
FRAMES = np.array([-4, -2, -1, 1, 2, 4])


def body(
    turn_deg: tuple[float, float, float] = (0, 3, 0), strain: float = 0.0, slope: float = 0.0, noise_px: float = 0.05
) -> Patch:
    """An ellipsoid, 60 px wide at 4 units, to 4 frames before and after.

    Args:
        turn_deg: per frame. strain: of a bulge that swings in 12 frames. slope: how much deeper a pixel further right
            is, as that of a wall along the line of sight.
    """
    uv = np.argwhere(np.ones((22, 28), bool))[:, ::-1] * 2.0 + [40.0, 30.0]
    rays = np.concatenate([(uv - K[:2, 2]) / K.diagonal()[:2], np.ones((len(uv), 1))], axis=1)
    across = (uv - uv.mean(axis=0)) / [30.0, 24.0]
    depth = 4 - 0.35 * np.sqrt(np.maximum(1.2 - np.square(across).sum(axis=1), 0)) + slope * across[:, 0]
    points = rays * depth[:, None]
    centre = points.mean(axis=0)
    flow = np.zeros((len(FRAMES), len(uv), 2))
    for row, k in zip(flow, FRAMES, strict=True):
        swing = strain * (np.sin(2 * np.pi * (k + 2) / 12) - np.sin(2 * np.pi * 2 / 12))
        bulge = 0.35 * swing * np.stack([across[:, 1] ** 2, across[:, 0] * across[:, 1], 0 * depth], axis=-1)
        turn = Rotation.from_euler("xyz", k * np.array(turn_deg), degrees=True)
        there = turn.apply(points + bulge - centre) + centre + k * np.array([0.03, -0.01, 0.02])
        seen = there @ K.T
        row[:] = seen[:, :2] / seen[:, 2:] - uv
    flow += noise_px * np.random.default_rng(0).standard_normal(flow.shape)
    return Patch(uv, flow, np.ones(flow.shape[:2], bool), K, np.tile(K, (len(FRAMES), 1, 1)))
