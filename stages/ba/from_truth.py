"""Ground-truth poses and depth in place of estimates, to measure what errors of bundle adjustment cost later stages."""

import cv2
import numpy as np

from stages.ba.depth import DepthMaps
from stages.ba.state import State
from stages.shared import lie, sintel
from stages.shared.cameras import frame_from_grid, pixel_grid
from stages.shared.errors import InputError
from stages.shared.sequences import Sequence

RELATIVE_STD = 1e-3
"""Relative standard deviation of true inverse depth: about the error of resampling it to the grid."""
MIN_INVERSE_DEPTH = 1e-3
"""Smallest inverse depth, in units of the median; the sky gets it."""
ROUNDING = 1e-9


def true_depth_maps(frames: Sequence, estimated: DepthMaps, stride_px: float, scale: float | None) -> DepthMaps:
    """True inverse depth on the grid of the estimated maps and in their scale; nothing is filled in.

    Args:
        stride_px: pixels of the full frame per pixel of the grid.
        scale: length in the gauge of the poses over true length; None: the median ratio to the estimated maps is used.
    """
    shape = estimated.inverse_depth.shape[1:]
    inverse_depth = np.stack([resample(1 / depth, shape, stride_px) for depth in true_depths(frames)])
    if scale is None:
        used = ~estimated.filled if not estimated.filled.all() else np.ones_like(estimated.filled)
        scale = float(np.median(inverse_depth[used] / estimated.inverse_depth[used]))
    inverse_depth = np.maximum(inverse_depth / scale, MIN_INVERSE_DEPTH)
    return DepthMaps(inverse_depth, (RELATIVE_STD * inverse_depth) ** 2, np.zeros_like(estimated.filled))


def gauge_scale(state: State, true_cam_from_world: np.ndarray) -> float | None:
    """Length in the gauge over true length, from the path of the camera; None if it does not move."""
    length = path_length(true_cam_from_world)
    return path_length(state.cam_from_world) / length if length > 0 else None


def path_length(cam_from_world: np.ndarray) -> float:
    """Length of the path of the camera centre; 0 if it is within rounding errors."""
    centres = lie.inverse(cam_from_world)[:, :3, 3]
    length = float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())
    return length if length > ROUNDING * np.abs(centres).max() else 0.0


def true_poses(frames: Sequence) -> np.ndarray:
    """The true cam_from_world [T, 4, 4].

    Raises:
        InputError: if a camera is missing.
    """
    _require(frames, "camdata_left", "poses")
    return sintel.read_cams(frames.truth_files("camdata_left"))[1]


def true_depths(frames: Sequence) -> list[np.ndarray]:
    """The true z-depth of every frame [H, W], float64, positive; infinite where there is no surface.

    Raises:
        InputError: if the depth of a frame is missing.
    """
    _require(frames, "depth", "depth")
    depths = [sintel.read_dpt(path).astype(float) for path in frames.truth_files("depth")]
    return [np.where(depth > 0, depth, np.inf) for depth in depths]


def _require(frames: Sequence, kind: str, option: str) -> None:
    if not frames.has_truth(kind):
        expected = f"{kind} beside the frames for `ba: {{{option}_from: truth}}`"
        raise InputError(frames.frames[0].parent, expected, "none", f"set `ba: {{{option}_from: estimate}}`")


def resample(image: np.ndarray, shape: tuple[int, ...], stride_px: float) -> np.ndarray:
    """An image [H, W] sampled at the pixels of a grid [h, w], nearest neighbour: edges stay sharp."""
    columns, rows = cv2.split(frame_from_grid(pixel_grid(*shape), stride_px).astype(np.float32))
    near = cv2.remap(image.astype(np.float32), columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    return near.astype(float)
