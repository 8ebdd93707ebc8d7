"""A textured square that moves before ground which a camera passes, and its flow, which is known on one part alone."""

import cv2
import numpy as np

from stages.segment.static_world import StaticWorld
from stages.segment.superpixels import Superpixels
from stages.shared.cameras import Cameras, intrinsics, make_cameras

T, H, W = 5, 96, 256
TILE_PX = 8
GROUND_PX, MOVER_PX = 2, -3
"""Motion to the right from frame to frame."""


def square(k: int) -> np.ndarray:
    """The mover in frame k, [H, W] bool; its flow is known on the left part alone."""
    mover = np.zeros((H, W), bool)
    mover[24:72, 120 + MOVER_PX * k : 184 + MOVER_PX * k] = True
    return mover


def left_part(k: int) -> np.ndarray:
    """The part of the mover that is known to move, [H, W] bool."""
    return square(k) & (np.arange(W) < 160 + MOVER_PX * k)


def clip(contrast: int, ground_px: int = GROUND_PX) -> np.ndarray:
    """Frames [T, H, W, 3] of a textured square before ground that a camera passes; with no contrast both are flat."""
    random = np.random.default_rng(0)
    noise = (random.normal(128, contrast, (H, 2 * W, 3)) for _ in range(2))
    ground, thing = (cv2.GaussianBlur(image, (0, 0), 1.5).clip(0, 255) for image in noise)
    frames = []
    for k in range(T):
        rgb = np.roll(ground, ground_px * k, axis=1)[:, :W]
        frames.append(np.where(square(k)[..., None], np.roll(thing, MOVER_PX * k, axis=1)[:, :W], rgb))
    return np.stack(frames).astype(np.uint8)


def flow_columns(ground_px: int = GROUND_PX) -> dict[str, np.ndarray]:
    """Flow of the ground everywhere but on the left part of the mover."""
    source, target = np.array([(i, j) for i in range(T) for j in range(T) if 1 <= abs(i - j) <= 2]).T
    flow = np.zeros((len(source), H, W, 2), np.float32)
    for e, (i, j) in enumerate(zip(source, target, strict=True)):
        flow[e, ..., 0] = np.where(left_part(i), MOVER_PX, ground_px) * (j - i)
    return {"source": source, "target": target, "flow": flow, "confidence": np.ones(flow.shape[:3], np.float32)}


def static_cameras(ground_px: int = GROUND_PX) -> Cameras:
    """Cameras that move to the left before a wall at depth 1: its picture moves by `ground_px` from frame to frame."""
    poses = np.tile(np.eye(4), (T, 1, 1))
    poses[:, 0, 3] = ground_px / 100 * np.arange(T)
    return make_cameras(poses, intrinsics(100, 100, W / 2, H / 2), np.arange(1, T + 1))


def static_world(ground_px: int = GROUND_PX) -> StaticWorld:
    """These cameras and the wall, by the depth of the adjustment alone."""
    cameras, wall = static_cameras(ground_px), np.ones((H, W), np.float32)
    return StaticWorld(cameras, cameras.Ks, lambda _: wall, lambda _: (wall, np.zeros((H, W), bool)))


def tiles() -> Superpixels:
    """Squares of 8 px in place of superpixels."""
    v, u = np.mgrid[:H, :W] // TILE_PX
    labels, count = v * (W // TILE_PX) + u, H * W // TILE_PX**2
    first = count * np.arange(T + 1)
    return Superpixels(np.stack(T * [labels]).astype(np.uint16), first, np.full(first[-1], TILE_PX**2), np.zeros(0))
