"""Training inputs, read from the artifacts of the other stages."""

from pathlib import Path

import cv2
import numpy as np

from stages.gaussians.training_frames import TrainingFrames
from stages.shared.artifacts import read_dense, read_metadata
from stages.shared.cameras import Cameras, read_cameras
from stages.shared.dense_depth import dense_depth, nearest_on_frame
from stages.shared.frame_store import Computed, PackedMasks, StoredFrames
from stages.shared.images import read_rgb
from stages.shared.log import logger, progress
from stages.shared.masks import read_burnt_in, read_mask
from stages.shared.sequences import read_sequence
from stages.shared.split import SplitOptions, frame_times, held_out

REACH_PX = 3
PICTURE_BYTES = 500_000_000
"""Memory for decoded frames."""
MIN_OBSERVED = 2
"""Least number of training frames: tables over time are interpolated between them."""


def read_observations(
    sequence: Path, masks: Path, poses: Path, depth: Path, split: SplitOptions, scratch: Path | None = None
) -> TrainingFrames:
    """The training frames (`training_indices`) with masks, depth and cameras. Held-out images and masks stay unread.

    Masks of frames where `Cameras.masks_used` is false are empty. Images are read from their files when they are used,
    and kept as far as PICTURE_BYTES go.

    Args:
        scratch: folder on whose disk the depth is kept; None: that of temporary files.

    Raises:
        InputError: if a mask is missing or has another size than the frames.
    """
    content, cameras = read_sequence(sequence), read_cameras(poses)
    frames = training_indices(cameras, split).tolist()
    burnt_in = read_burnt_in(content)
    size, F = (content.height, content.width), len(frames)
    pictures = Computed(
        F, lambda f: without(burnt_in, read_rgb(content.frames[frames[f]])), PICTURE_BYTES // (3 * size[0] * size[1])
    )
    images = Computed(F, lambda f: pictures[f].astype(np.float32) / 255)
    grid, stride_px = read_dense(depth), float(read_metadata(depth)["stride_px"])
    filled = grid["filled"][frames] > 0
    moving = ((f, read_mask(masks, content, k) & cameras.masks_used[k]) for f, k in enumerate(frames))
    dense = (dense_depth(grid["inverse_depth"][frames[f]], images[f], stride_px) for f in progress(range(F), "reading"))
    return TrainingFrames(
        images,
        PackedMasks(moving),
        StoredFrames(dense, scratch),
        Computed(F, lambda f: nearest_on_frame(filled[f : f + 1], stride_px, *size)[0]),
        cameras.cam_from_world[frames],
        cameras.Ks[frames],
        frame_times(len(content.frames))[frames],
        None if burnt_in is None else ~burnt_in,
    )


def without(burnt_in: np.ndarray | None, image: np.ndarray) -> np.ndarray:
    """A frame [H, W, 3] uint8 whose surroundings are continued over what is burnt in [H, W] (Telea, JGT 2004).

    Nothing is trained there. But windows of SSIM and filters of the depth reach over its outline.
    """
    if burnt_in is None:
        return image
    return np.asarray(cv2.inpaint(image, burnt_in.astype(np.uint8), REACH_PX, cv2.INPAINT_TELEA))


def training_indices(cameras: Cameras, split: SplitOptions) -> np.ndarray:
    """Indices [F] of the frames to train on: neither held out nor "unobserved" (without matches).

    The pose of an unobserved frame is interpolated from its neighbours; training on a wrong pose would blur the scene.
    Such frames are kept, with a warning, if fewer than MIN_OBSERVED others are left.
    """
    training = ~held_out(len(cameras.numbers), split)
    unobserved = training & (cameras.status == "unobserved")
    if not unobserved.any():
        return np.flatnonzero(training)
    numbers = cameras.numbers[unobserved].tolist()
    if (training & ~unobserved).sum() < MIN_OBSERVED:
        logger.warning(
            "gaussians: trained on frames %s without matches of their own: hardly any other is left", numbers
        )
        return np.flatnonzero(training)
    logger.warning("gaussians: frames %s have no matches of their own and are left out of the training", numbers)
    return np.flatnonzero(training & ~unobserved)


def canonical_row(seen: TrainingFrames, sequence: Path, deformation: Path) -> int:
    """Index, among the training frames, of the canonical frame of the control points."""
    numbers = read_sequence(sequence).numbers
    time = frame_times(len(numbers))[numbers.index(read_metadata(deformation)["canonical_frame"])]
    return int(np.abs(seen.times - time).argmin())
