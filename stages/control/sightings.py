"""Tracks lifted into the world: their depth, from the pose stage, smoothed over time."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.linalg import solveh_banded

from stages.control.tracks import Tracks, sightings_by_frame
from stages.shared.cameras import Cameras, frame_from_grid, grid_from_frame, unproject
from stages.shared.log import progress
from stages.shared.warp import bilinear

MIN_DEPTH_STD = 0.01
DEPTH_ACCELERATION = 0.02
"""Expected second difference of log depth per frame^2 along a track."""
BLOCK = 1024
"""Tracks whose depth in all frames is held at the same time."""
DEPTH_SPEED = 1.0
"""Expected first difference of log depth per frame; it is weak and only matters for tracks seen once or twice."""


@dataclass(frozen=True)
class Sightings:
    """M sightings of n tracks in F training frames, by track and then by frame, in full-frame pixels with their depth.

    Attributes:
        frames: [F] 0-based frame indices. times: [F] in 0..1. n: number of tracks.
        track, frame: [M], which of the n tracks and of the F frames.
        uv: [M, 2]. depth: [M] smoothed z-depth. depth_std: [M], relative. moved: [M, 3] positions in the world.
    """

    frames: np.ndarray
    times: np.ndarray
    n: int
    track: np.ndarray
    frame: np.ndarray
    uv: np.ndarray
    depth: np.ndarray
    depth_std: np.ndarray
    moved: np.ndarray

    @cached_property
    def starts(self) -> np.ndarray:
        """The first sighting [n + 1] of each track, and M."""
        return np.searchsorted(self.track, np.arange(self.n + 1))

    def spread(self, values: np.ndarray, tracks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values [M, ...] of some tracks [m] as [m, F, ...], 0 where there is no sighting, and where there is one."""
        table = np.zeros((len(tracks), len(self.frames), *values.shape[1:]), values.dtype)
        visible = np.zeros(table.shape[:2], bool)
        for row, track in enumerate(tracks.tolist()):
            of_track = slice(self.starts[track], self.starts[track + 1])
            table[row, self.frame[of_track]] = values[of_track]
            visible[row, self.frame[of_track]] = True
        return table, visible

    def only(self, kept: np.ndarray) -> "Sightings":
        """Those of the tracks that are kept, [n] bool, numbered anew."""
        rows, numbers = kept[self.track], np.cumsum(kept) - 1
        parts = (self.uv, self.depth, self.depth_std, self.moved)
        sighted = (numbers[self.track[rows]], self.frame[rows], *(values[rows] for values in parts))
        return Sightings(self.frames, self.times, int(kept.sum()), *sighted)

    def blocks(self) -> Iterator[np.ndarray]:
        """All tracks, BLOCK at a time."""
        for first in range(0, self.n, BLOCK):
            yield np.arange(first, min(first + BLOCK, self.n))


def smooth_log_depth(log_depth: np.ndarray, std: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Log depth [n, F] along each track, smoothed over time and defined in every frame.

    Minimises sum_f visible ((z_f - y_f) / std_f)^2 + sum_f (second difference / DEPTH_ACCELERATION)^2 (Whittaker) and
    (first difference / DEPTH_SPEED)^2. For fewer than 3 frames it is the weighted mean.
    The depth of dynamic pixels is a guess (`stages.ba.mover_depth`), with a large std; smoothing averages it.

    Args:
        log_depth: [n, F] measurements. std: [n, F] > 0, of log depth. visible: [n, F], each row at least once true.
    """
    n, F = log_depth.shape
    precision = np.where(visible, 1 / std**2, 0.0)
    if F < 3:
        mean = (precision * log_depth).sum(axis=1, keepdims=True) / precision.sum(axis=1, keepdims=True)
        return np.broadcast_to(mean, (n, F)).copy()
    bands, smoothed = _penalty(F), np.empty((n, F))
    for j in range(n):
        banded = bands.copy()
        banded[2] += precision[j]
        smoothed[j] = solveh_banded(banded, precision[j] * np.where(visible[j], log_depth[j], 0.0))
    return smoothed


def _penalty(F: int) -> np.ndarray:
    """Both penalties of F >= 3 frames as a symmetric matrix in upper bands [3, F], the diagonal last."""
    D = sparse.diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(F - 2, F)) / DEPTH_ACCELERATION
    D1 = sparse.diags_array([-1.0, 1.0], offsets=[0, 1], shape=(F - 1, F)) / DEPTH_SPEED
    penalty = D.T @ D + D1.T @ D1
    return np.stack([np.r_[np.zeros(2 - k), penalty.diagonal(2 - k)] for k in range(3)])


def sample_depth(
    uv: np.ndarray, inverse_depth: np.ndarray, variance: np.ndarray, stride_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """Log z-depth [m] and its standard deviation at full-frame pixels uv [m, 2] of a frame, from the solver's grid.

    Args:
        inverse_depth: [h, w] > 0. variance: [h, w] of it.
        stride_px: full-frame pixels per pixel of the grid, as in `frame_from_grid`.
    """
    grid_uv = grid_from_frame(uv, stride_px)
    log_depth = -bilinear(np.log(inverse_depth), grid_uv)
    std = bilinear(np.sqrt(variance) / inverse_depth, grid_uv)
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
    uv, M = frame_from_grid(tracks.uv.astype(float), 1 / scale), len(tracks.track)
    log_depth, std, depth, moved = np.zeros(M), np.ones(M), np.zeros(M), np.zeros((M, 3))
    by_frame = sightings_by_frame(tracks)
    for k, rows in enumerate(by_frame):
        log_depth[rows], std[rows] = sample_depth(uv[rows], inverse_depth[k], variance[k], stride_px)
    found = Sightings(frames, frames / (T - 1), tracks.n, tracks.track, tracks.frame, uv, depth, std, moved)
    for block in progress(list(found.blocks()), "depth of tracks"):
        (logs, visible), (deviations, _) = (found.spread(values, block) for values in (log_depth, std))
        smoothed = np.exp(smooth_log_depth(logs, np.where(visible, deviations, 1.0), visible))
        depth[found.starts[block[0]] : found.starts[block[-1] + 1]] = smoothed[visible]
    for frame, rows in zip(frames, by_frame, strict=True):
        moved[rows] = unproject(uv[rows], depth[rows], cameras.cam_from_world[frame], cameras.Ks[frame])
    return found
