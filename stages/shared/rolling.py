"""Rolling shutter: rows that are exposed one after the other, each with a camera pose of its own.

The camera at the time of a row is interpolated between the poses of neighbouring frames, which are those of the middle
row. What that changes in flow follows from poses and depth, and can be taken out of it.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from stages.shared import lie
from stages.shared.artifacts import Dense, read_dense, read_metadata
from stages.shared.cameras import (
    Cameras,
    frame_from_grid,
    grid_from_frame,
    pixel_grid,
    projection,
    scale_intrinsics,
)
from stages.shared.flow_pairs import FlowPairs
from stages.shared.rows import Rows
from stages.shared.sequences import Sequence
from stages.shared.static_flow import Z_MIN
from stages.shared.warp import bilinear


def frame_times(T: int, times_s: np.ndarray | None) -> np.ndarray:
    """Times [T] of the frames, in units of their usual interval: a phone may have dropped some."""
    if times_s is None:
        return np.arange(T, dtype=float)
    return np.asarray((times_s - times_s[0]) / np.median(np.diff(times_s)))


def path_of(cam_from_world: np.ndarray, times: np.ndarray) -> CubicSpline:
    """A curve [6] over time: its change from the time of a frame on is the left twist of the camera since that frame.

    A cubic spline through the sum of the twists from frame to frame: the twists of neighbouring frames nearly commute.

    Args:
        times: [T] of the frames, as of `frame_times`.
    """
    steps = lie.log_se3(cam_from_world[1:] @ lie.inverse(cam_from_world[:-1]))
    return CubicSpline(times, np.append(np.zeros((1, 6)), np.cumsum(steps, axis=0), axis=0))


def moved_by(points: np.ndarray, d: np.ndarray, twists: np.ndarray) -> np.ndarray:
    """Points [..., 3], scaled by their inverse depths d [...], after small motions [..., 6], to second order in the
    turn."""
    step = lie.cross(twists[..., 3:], points) + d[..., None] * twists[..., :3]
    return np.asarray(points + step + lie.cross(twists[..., 3:], step) / 2)


@dataclass(frozen=True)
class RollingShutter:
    """Frames whose rows are exposed in turn.

    Attributes:
        readout: time from the first row to the last, in frames. times: [T] of `frame_times`.
        cam_from_world: [T, 4, 4] of the middle rows. Ks: [T, 3, 3] of the flow grid.
        inverse_depth: [T, rows, columns] of cells of `cell_px` px of the flow grid.
    """

    readout: float
    times: np.ndarray
    cam_from_world: np.ndarray
    Ks: np.ndarray
    inverse_depth: np.ndarray
    cell_px: float

    @cached_property
    def path(self) -> CubicSpline:
        """The path of the camera over the times, as of `path_of`."""
        return path_of(self.cam_from_world, self.times)

    def shifts(self, i: int, j: int, flow: np.ndarray) -> np.ndarray:
        """How far [h, w, 2] px the flow [h, w, 2] from frame i to frame j leads because rows are exposed in turn.

        Known where depth is, at the cells, and bilinear between. Rows outside of the frame count as its first or last:
        nothing is matched there.
        """
        h, w = flow.shape[:2]
        d, (K, other_K) = self.inverse_depth[i], self.Ks[[i, j]]
        pixels = frame_from_grid(pixel_grid(*d.shape), self.cell_px)
        relative = self.cam_from_world[j] @ lie.inverse(self.cam_from_world[i])
        rays = np.dstack([(pixels - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(d.shape)])
        turned = moved_by(rays, d, -self._twists(i, pixels[:, :1, 1] / (h - 1)))
        at_once, begun = (points @ relative[:3, :3].T + d[..., None] * relative[:3, 3] for points in (rays, turned))
        rows = np.clip(pixels[..., 1] + bilinear(flow[..., 1], pixels), 0, h - 1)
        in_turn = moved_by(begun, d, self._twists(j, rows / (h - 1)))
        ahead = np.minimum(at_once[..., 2], in_turn[..., 2]) > Z_MIN
        before, after = (points[..., :2] / np.maximum(points[..., 2:], Z_MIN) for points in (at_once, in_turn))
        moved = np.where(ahead[..., None], (after - before) * other_K[[0, 1], [0, 1]], 0.0)
        return bilinear(moved.astype(np.float32), grid_from_frame(pixel_grid(h, w), self.cell_px))

    def at_once(self, i: int, j: int, flow: np.ndarray) -> np.ndarray:
        """Flow [h, w, 2] float32 from frame i to frame j as if all rows were exposed at once."""
        matched = flow.astype(np.float32)
        return np.asarray(matched - self.shifts(i, j, matched))

    def taken_out(self, pairs: FlowPairs) -> FlowPairs:
        """The pairs with flow as if all rows were exposed at once, computed where it is read."""

        def row(e: int) -> np.ndarray:
            return self.at_once(int(pairs.source[e]), int(pairs.target[e]), pairs.flow[e]).astype(np.float16)

        corrected: Any = Rows(len(pairs.source), np.broadcast_to(np.float16(0), pairs.flow.shape[1:]), row)
        return replace(pairs, columns=Dense({**pairs.columns, "flow": corrected}))

    def projection(self, i: int, j: int, h: int) -> tuple[np.ndarray, np.ndarray]:
        """`cameras.projection` of every row of frame i into frame j, A [h, 3, 3] and b [h, 3], of frames h px high.

        A row is taken to be seen when that row of frame j is exposed on which its middle would be at its median depth
        if all rows were exposed at once.
        """
        K, cells = self.Ks[i], self.inverse_depth[i]
        rows = np.arange(h)
        d = np.interp(rows, frame_from_grid(np.arange(len(cells)), self.cell_px), np.median(cells, axis=1))
        A, b = projection((self.cam_from_world[i], K), (self.cam_from_world[j], self.Ks[j]))
        there = np.column_stack([np.full(h, K[0, 2]), rows, np.ones(h)]) @ A.T + d[:, None] * b
        seen = np.clip(there[:, 1] / np.maximum(there[:, 2], Z_MIN), 0, h - 1)
        return projection((self._poses(i, rows / (h - 1)), K), (self._poses(j, seen / (h - 1)), self.Ks[j]))

    def projections(self, pairs: FlowPairs, h: int) -> tuple[np.ndarray, np.ndarray]:
        """`projection` of every edge, A [E, h, 3, 3] and b [E, h, 3], float32."""
        found = [self.projection(int(i), int(j), h) for i, j in zip(pairs.source, pairs.target, strict=True)]
        A, b = (np.array(part, np.float32) for part in zip(*found, strict=True))
        return A, b

    def _poses(self, k: int, down: np.ndarray) -> np.ndarray:
        """cam_from_world [n, 4, 4] of rows [n] of frame k, as shares of its height."""
        return np.asarray(lie.exp_se3(self._twists(k, down)) @ self.cam_from_world[k])

    def _twists(self, k: int, down: np.ndarray) -> np.ndarray:
        """Twists [..., 6] of the camera from the middle row of frame k to rows [...], as shares of its height."""
        return np.asarray(self.path(self.times[k] + self.readout * (down - 0.5)) - self.path(self.times[k]))


def rolling_shutter(sequence: Sequence, cameras: Cameras, readout: float, depth: Path, scale: float) -> RollingShutter:
    """Of the cameras of a sequence and their depth.

    Args:
        readout: of `cameras.read_readout`. depth: depth.arrow. scale: pixels of the flow grid per pixel of the frame.
    """
    T, times_s = len(sequence.numbers), sequence.times_s
    times = frame_times(T, None if times_s is None else np.array(times_s))
    cell_px = float(read_metadata(depth)["stride_px"]) * scale
    cells = read_dense(depth)["inverse_depth"]
    return RollingShutter(readout, times, cameras.cam_from_world, scale_intrinsics(cameras.Ks, scale), cells, cell_px)
