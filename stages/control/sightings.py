"""Tracks lifted into the world: their depth, from the pose stage, smoothed over time."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solveh_banded

from stages.control.tracks import Tracks
from stages.shared.cameras import Cameras, frame_from_grid, grid_from_frame, unproject
from stages.shared.warp import bilinear

MIN_DEPTH_STD = 0.01
DEPTH_ACCELERATION = 0.02
"""Expected second difference of log depth per frame^2 along a track."""
DEPTH_SPEED = 1.0
"""Expected first difference of log depth per frame; it is weak and only matters for tracks seen once or twice."""


@dataclass(frozen=True)
class Sightings:
    """Tracks in full-frame pixels with their depth; n tracks, F training frames.

    Attributes:
        frames: [F] 0-based frame indices. times: [F] in 0..1.
        uv: [n, F, 2]. visible: [n, F]. depth: [n, F] smoothed z-depth. depth_std: [n, F], relative.
        moved: [n, F, 3] positions in the world.
    """

    frames: np.ndarray
    times: np.ndarray
    uv: np.ndarray
    visible: np.ndarray
    depth: np.ndarray
    depth_std: np.ndarray
    moved: np.ndarray


def smooth_log_depth(log_depth: np.ndarray, std: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Log depth [n, F] along each track, smoothed over time and defined in every frame.

    Minimises sum_f visible ((z_f - y_f) / std_f)^2 + sum_f (second difference / DEPTH_ACCELERATION)^2 (Whittaker) and
    (first difference / DEPTH_SPEED)^2. For fewer than 3 frames it is the weighted mean.
    The depth of dynamic pixels is estimated from the border of the mask, with a large std; smoothing averages it.

    Args:
        log_depth: [n, F] measurements. std: [n, F] > 0, of log depth. visible: [n, F], each row at least once true.
    """
    n, F = log_depth.shape
    precision = np.where(visible, 1 / std**2, 0.0)
    if F < 3:
        mean = (precision * log_depth).sum(axis=1, keepdims=True) / precision.sum(axis=1, keepdims=True)
        return np.broadcast_to(mean, (n, F)).copy()
    D = np.diff(np.eye(F), n=2, axis=0) / DEPTH_ACCELERATION
    D1 = np.diff(np.eye(F), axis=0) / DEPTH_SPEED
    penalty = D.T @ D + D1.T @ D1
    bands = np.stack([np.r_[np.zeros(2 - k), np.diag(penalty, 2 - k)] for k in range(3)])
    smoothed = np.empty((n, F))
    for j in range(n):
        banded = bands.copy()
        banded[2] += precision[j]
        smoothed[j] = solveh_banded(banded, precision[j] * np.where(visible[j], log_depth[j], 0.0))
    return smoothed


def sample_depth(
    uv: np.ndarray, inverse_depth: np.ndarray, variance: np.ndarray, stride_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """Log z-depth [n, F] and its standard deviation at full-frame pixels uv [n, F, 2], from the solver's grid.

    Args:
        inverse_depth: [F, h, w] > 0. variance: [F, h, w] of it.
        stride_px: full-frame pixels per pixel of the grid, as in `frame_from_grid`.
    """
    grid_uv = grid_from_frame(uv, stride_px)
    F = uv.shape[1]
    log_depth = np.stack([-bilinear(np.log(inverse_depth[k]), grid_uv[:, k]) for k in range(F)], axis=1)
    relative_std = np.sqrt(variance) / inverse_depth
    std = np.stack([bilinear(relative_std[k], grid_uv[:, k]) for k in range(F)], axis=1)
    return log_depth.astype(float), np.maximum(std, MIN_DEPTH_STD).astype(float)


def lift(
    tracks: Tracks,
    frames: np.ndarray,
    T: int,
    scale: float,
    inverse_depth: np.ndarray,
    variance: np.ndarray,
    stride_px: float,
    cameras: Cameras,
) -> Sightings:
    """Lift tracks to world positions with depth smoothed along each track.

    Args:
        frames: [F] training frames of T. scale: flow grid width / frame width.
        inverse_depth, variance: [F, h, w] of the training frames, as in `sample_depth`.
    """
    uv = frame_from_grid(tracks.uv.astype(float), 1 / scale)
    log_depth, std = sample_depth(uv, inverse_depth, variance, stride_px)
    depth = np.exp(smooth_log_depth(log_depth, std, tracks.visible))
    moved = np.zeros((*depth.shape, 3))
    for k, frame in enumerate(frames):
        moved[:, k] = unproject(uv[:, k], depth[:, k], cameras.cam_from_world[frame], cameras.Ks[frame])
    return Sightings(frames, frames / (T - 1), uv, tracks.visible, depth, std, moved)
