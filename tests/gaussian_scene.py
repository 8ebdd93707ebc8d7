"""A small scene with exact truth, ray-cast in numpy: a textured wall and a square that slides in front of it."""

from pathlib import Path

import numpy as np
import torch

from stages.deformation.motion_models import TableDeformation
from stages.gaussians.training_frames import TrainingFrames
from stages.shared.artifacts import write_dense, write_json
from stages.shared.cameras import centred_intrinsics, make_cameras, pixel_grid, write_cameras
from stages.shared.images import write_image
from stages.shared.sequences import check_sequence, sequence_to_json

WIDTH, HEIGHT, T = 96, 64, 10
WALL_Z, SQUARE_Z, HALF = 4.0, 2.5, 0.35
K = centred_intrinsics(90.0, WIDTH, HEIGHT)
TIMES = np.arange(T) / (T - 1)


def cameras(unit: float = 1.0) -> np.ndarray:
    """cam_from_world [T, 4, 4]: the camera slides right and a little forward, lengths times `unit`."""
    poses = np.tile(np.eye(4), (T, 1, 1))
    poses[:, 0, 3], poses[:, 2, 3] = -0.4 * unit * TIMES, -0.2 * unit * TIMES
    return poses


def square_centre(time: float) -> np.ndarray:
    """Where the square is at `time` 0..1, world [3]."""
    return np.array([-0.5 + 1.1 * time, 0.1 * np.sin(3 * time), SQUARE_Z])


def texture(x: np.ndarray, y: np.ndarray, seed: int) -> np.ndarray:
    """Smooth colours [..., 3] in 0..1."""
    random = np.random.default_rng(seed)
    waves = random.normal(scale=3.5, size=(6, 2, 3))
    phases = random.uniform(0, 6, (6, 3))
    angles = np.einsum("...a,kac->...kc", np.stack([x, y], axis=-1), waves) + phases
    return np.asarray(0.5 + 0.45 * np.sin(angles).mean(axis=-2) * 1.5).clip(0, 1)


def ray_cast(cam_from_world: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image [H, W, 3], z-depth [H, W] and mask [H, W] of one moment; the cameras do not turn."""
    centre = -cam_from_world[:3, 3]
    grid = pixel_grid(HEIGHT, WIDTH)
    slope = np.stack([(grid[..., 0] - K[0, 2]) / K[0, 0], (grid[..., 1] - K[1, 2]) / K[1, 1]], axis=-1)
    wall = centre[:2] + slope * (WALL_Z - centre[2])
    front = centre[:2] + slope * (SQUARE_Z - centre[2]) - square_centre(time)[:2]
    mask = (np.abs(front) < HALF).all(axis=-1)
    image = np.where(mask[..., None], texture(*np.moveaxis(3 * front, -1, 0), 1), texture(*np.moveaxis(wall, -1, 0), 2))
    depth = np.where(mask, SQUARE_Z, WALL_Z) - centre[2]
    return image.astype(np.float32), depth.astype(np.float32), mask


def observations(frames: list[int], unit: float = 1.0) -> TrainingFrames:
    """The truth of `frames`, as the training sees it."""
    poses = cameras()
    images, depths, masks = (np.stack(x) for x in zip(*(ray_cast(poses[k], TIMES[k]) for k in frames), strict=True))
    guessed = np.zeros_like(masks)
    Ks = np.tile(K, (len(frames), 1, 1))
    return TrainingFrames(images, masks, unit * depths, guessed, cameras(unit)[frames], Ks, TIMES[frames])


def true_motion(unit: float = 1.0) -> TableDeformation:
    """Control points on the square, resting where it is in the middle of the clip, that move exactly as it does."""
    middle = square_centre(TIMES[T // 2])
    side = np.linspace(-HALF, HALF, 4)
    offsets = np.stack([*np.meshgrid(side, side), np.zeros((4, 4))], axis=-1).reshape(-1, 3)
    points = torch.tensor(unit * (middle + offsets), dtype=torch.float32)
    motion = TableDeformation(points, torch.full((len(points),), np.log(0.2 * unit)), torch.tensor(TIMES))
    shifts = np.stack([square_centre(time) - middle for time in TIMES]) * unit
    with torch.no_grad():
        motion.table[..., 4:] = torch.tensor(shifts, dtype=torch.float32)[:, None] / motion.extent
    return motion


def write_artifacts(folder: Path, stride_px: int = 4) -> None:
    """All that train.py reads but the control points: frames/, sequence.json, masks/, poses, depth, scene.json."""
    inverse_depths = []
    for k, pose in enumerate(cameras()):
        image, depth, mask = ray_cast(pose, TIMES[k])
        write_image(folder / "frames" / f"frame_{k + 1:04d}.png", np.round(255 * image).astype(np.uint8))
        write_image(folder / "masks" / f"frame_{k + 1:04d}.png", mask)
        inverse_depths.append(1 / depth[stride_px // 2 :: stride_px, stride_px // 2 :: stride_px])
    inverse_depth = np.stack(inverse_depths)
    write_json(folder / "sequence.json", sequence_to_json(check_sequence("square", folder / "frames")))
    write_cameras(folder / "poses.parquet", make_cameras(cameras(), K, np.arange(1, T + 1)))
    columns = {"frame": np.arange(1, T + 1), "inverse_depth": inverse_depth, "variance": 0.0 * inverse_depth}
    columns["filled"] = np.zeros(inverse_depth.shape, np.uint8)
    write_dense(folder / "depth.arrow", columns, {"stride_px": stride_px})
    decisions = {"dynamic": {"needed": True}, "view_dependent": {"sh_degree": 0}, "non_rigid": {"arap_weight": 0.01}}
    off = {
        name: {"needed": False} for name in ("exposure", "white_balance", "atmosphere", "moving_shadows", "motion_blur")
    }
    write_json(folder / "scene.json", decisions | off)
