"""What is exported of a sequence: its frames, cameras, masks and depth, read from the artifacts of the other stages."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from stages.export.points import DepthGrid, measured
from stages.shared.artifacts import read_dense, read_metadata
from stages.shared.cameras import Cameras, frame_from_grid, has_pose, pixel_grid, read_cameras
from stages.shared.dense_depth import dense_depth, nearest_on_frame
from stages.shared.errors import InputError
from stages.shared.images import read_rgb
from stages.shared.log import logger
from stages.shared.masks import read_instances, read_mask
from stages.shared.sequences import Sequence, read_sequence
from stages.shared.warp import bilinear


@dataclass(frozen=True)
class Clip:
    """T frames with cameras, masks and depth.

    Attributes:
        content: the frames. cameras: of all frames. posed: [T] bool, whether a frame has an estimated pose.
        masks: the folder of masks. stride_px: frame pixels per pixel of the depth grid.
        inverse_depth: [T, h, w] in 1 / scene units. known: [T, h, w] bool, where it is triangulated (`measured`).
    """

    content: Sequence
    cameras: Cameras
    posed: np.ndarray
    masks: Path
    stride_px: float
    inverse_depth: np.ndarray
    known: np.ndarray

    @property
    def names(self) -> list[str]:
        """File names of all frames."""
        return [path.name for path in self.content.frames]

    def mask(self, k: int) -> np.ndarray:
        """The dynamic mask [H, W] bool of frame k as the later stages used it: empty where it was not trusted."""
        return read_mask(self.masks, self.content, k) & self.cameras.masks_used[k]

    def instances(self, k: int) -> np.ndarray:
        """The instances [H, W] uint16 of frame k, 0 where `mask` is empty."""
        return read_instances(self.masks, self.content, k) * self.mask(k)

    def depth(self, k: int) -> np.ndarray:
        """z-depth [H, W] float32 of frame k in scene units, filled in where it is not `depth_known`."""
        image = read_rgb(self.content.frames[k]).astype(np.float32) / 255
        return dense_depth(self.inverse_depth[k], image, self.stride_px)

    def depth_known(self, k: int) -> np.ndarray:
        """Where the depth of frame k is triangulated and static, [H, W] bool."""
        size = (self.content.height, self.content.width)
        return np.asarray(nearest_on_frame(self.known[k : k + 1], self.stride_px, *size)[0] & ~self.mask(k))

    def grid(self) -> DepthGrid:
        """Depth and colours of the frames with a pose, on the grid."""
        rows = np.flatnonzero(self.posed).tolist()
        uv = frame_from_grid(pixel_grid(*self.known.shape[1:]), self.stride_px)
        reach = np.ones([2 * math.ceil(self.stride_px / 2) + 1] * 2, np.uint8)  # all that a pixel of the grid covers
        moving = (cv2.dilate(self.mask(k).astype(np.uint8), reach) for k in rows)
        static = np.stack([bilinear(mask, uv) == 0 for mask in moving])
        colours = np.stack([np.rint(bilinear(read_rgb(self.content.frames[k]), uv)).astype(np.uint8) for k in rows])
        pose, Ks = self.cameras.cam_from_world[rows], self.cameras.Ks[rows]
        return DepthGrid(self.inverse_depth[rows], self.known[rows] & static, colours, self.stride_px, pose, Ks)

    def posed_frames(self) -> Iterator[tuple[int, Path]]:
        """Index and file of every frame with a pose."""
        return ((k, self.content.frames[k]) for k in np.flatnonzero(self.posed).tolist())


def read_clip(sequence: Path, poses: Path, masks: Path, depth: Path, needs_poses: bool = True) -> Clip:
    """The clip of these artifacts, with a warning for frames without a pose.

    Raises:
        InputError: if poses are needed and no frame has an estimated one, or poses or depth are of other frames.
    """
    content, cameras = read_sequence(sequence), read_cameras(poses)
    grid, stride_px = read_dense(depth), float(read_metadata(depth)["stride_px"])
    for path, numbers in {poses: cameras.numbers, depth: grid["frame"]}.items():
        if numbers.tolist() != content.numbers:
            said, found = (f"{len(of)} frames from {of[0]} on" for of in (content.numbers, numbers.tolist()))
            raise InputError(path, f"{said}, as in {sequence}", found, "give the files of one sequence and run")
    posed = has_pose(cameras)
    if needs_poses and not posed.any():
        found = f"the status '{cameras.status[0]}' for all {len(posed)} frames"
        advice = "the report says why the poses failed; without them there are `export: {formats: [masks]}`"
        raise InputError(poses, "estimated poses", found, advice)
    if needs_poses and not posed.all():
        numbers = cameras.numbers[~posed].tolist()
        logger.warning(
            "export: frames %s have no pose of their own: not in COLMAP's model and transforms.json", numbers
        )
    known = measured(grid["inverse_depth"], grid["variance"], grid["filled"])
    if needs_poses and not known.any():
        logger.warning("export: no depth is triangulated (%s): no points, and black depth images", cameras.status[0])
    return Clip(content, cameras, posed, masks, stride_px, grid["inverse_depth"], known)
