"""A wall seen by a camera that moves sideways, and a mover before it that hardly moves: frames, flow and cameras."""

import cv2
import numpy as np

from stages.motion import drift
from stages.motion.__main__ import CAMERA_CURVE
from stages.motion.static_paths import StaticScene
from stages.shared.artifacts import Dense
from stages.shared.cameras import centred_intrinsics, pixel_grid
from stages.shared.flow_pairs import FlowPairs
from stages.shared.warp import bilinear

T, H, W = 24, 96, 160
STEP = np.array([-1.0, 0.0])
"""Motion of the static wall from frame to frame, px: the camera moves to the right."""
SLOW = np.array([0.0, 0.1])
"""What the mover moves in addition, across the epipolar lines."""
FOUND = CAMERA_CURVE[0]


def where(k: int) -> np.ndarray:
    """Pixels [H, W] of the mover in frame k."""
    u, v = pixel_grid(H, W).transpose(2, 0, 1) - (k * (STEP + SLOW))[:, None, None]
    return np.asarray((u > 70) & (u < 110) & (v > 30) & (v < 60))


def frames(wall: np.ndarray, mover: np.ndarray | None) -> np.ndarray:
    """Frames [T, H, W, 3]: a wall moves by `wall` [2] px per frame, the mover before it, if any, by `mover`."""
    random = np.random.default_rng(0)
    size = (H + 60, W + 60)
    canvases = [cv2.GaussianBlur(random.normal(0, 1, size), (0, 0), 1.0) for _ in range(2)]
    of_things = [
        (level + 10 * canvas / canvas.std()).astype(np.float32)
        for level, canvas in zip((90, 160), canvases, strict=True)
    ]
    steps = np.stack([wall, wall if mover is None else mover])
    found = []
    for k in range(T):
        on_wall, on_mover = (
            bilinear(thing, pixel_grid(H, W) - k * step + [5.0, 30.0])
            for thing, step in zip(of_things, steps, strict=True)
        )
        found.append(on_wall if mover is None else np.where(where(k), on_mover, on_wall))
    return np.repeat(np.stack(found)[..., None], 3, axis=-1).round().astype(np.uint8)


def observed(wall: np.ndarray, mover: np.ndarray, noise_px: float = 0.0, scene: np.ndarray | None = None) -> FlowPairs:
    """Flow over one frame, both ways, with smooth noise that is new in every edge."""
    random = np.random.default_rng(1)
    edges = [(i, j) for i in range(T) for j in (i - 1, i + 1) if 0 <= j < T]
    source, target = np.array(edges).T
    flow = np.stack([(j - i) * np.where(where(i)[..., None], mover, wall) for i, j in edges])
    for of_edge in flow if noise_px else ():
        noise = cv2.GaussianBlur(random.normal(0, 1, (H, W, 2)), (0, 0), 2.0)
        of_edge += noise_px * noise / noise.std()
    confidence = np.full(flow.shape[:3], 0.8, np.float32)
    columns = {"source": source, "target": target, "flow": flow.astype(np.float32), "confidence": confidence}
    return FlowPairs(Dense(columns), scene=scene)


def cameras() -> tuple[np.ndarray, np.ndarray]:
    """Poses and intrinsics with which a wall at inverse depth 1 moves by STEP."""
    K, poses = centred_intrinsics(150.0, W, H), np.tile(np.eye(4), (T, 1, 1))
    poses[:, 0, 3] = np.arange(T) * STEP[0] / 150.0
    return poses, np.tile(K, (T, 1, 1))


def evidence(pairs: FlowPairs, rgb: np.ndarray, inverse_depth: np.ndarray | None = None) -> np.ndarray:
    """Evidence [T, H, W] of motion with true cameras and depth, or another inverse depth [T, H, W]."""
    ones = np.ones((T, H, W), np.float32)
    depth = ones if inverse_depth is None else inverse_depth
    return drift.drifting(StaticScene(pairs, rgb, cameras(), depth, 0 * ones), rgb)
