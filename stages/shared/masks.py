"""The folder of dynamic masks that the segment stage writes: one PNG per frame, 255 where something moves.

Beside them, the instances: what is connected over space and time has one number through the clip.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from stages.shared import images
from stages.shared.errors import InputError
from stages.shared.sequences import Sequence

ADVICE = "run the segment stage again"


def mask_path(folder: Path, number: int) -> Path:
    """Where the mask of the frame with this number lies."""
    return folder / f"frame_{number:04d}.png"


def instances_path(folder: Path, number: int) -> Path:
    """Where the instances of the frame with this number lie: 16 bit, 0 where static."""
    return folder / "instances" / f"frame_{number:04d}.png"


def read_mask(folder: Path, frames: Sequence, k: int) -> np.ndarray:
    """The dynamic mask [H, W] bool of frame k (0-based).

    Raises:
        InputError: if the file is missing, cannot be decoded or has another size than the frames.
    """
    path = mask_path(folder, frames.numbers[k])
    if not path.is_file():
        raise InputError(path, "a mask", "nothing there", ADVICE)
    mask = images.read_mask(path)
    if mask.shape != (frames.height, frames.width):
        raise InputError(path, f"{frames.width} x {frames.height}", f"{mask.shape[1]} x {mask.shape[0]}", ADVICE)
    return mask


def read_instances(folder: Path, frames: Sequence, k: int) -> np.ndarray:
    """The instances [H, W] uint16 of frame k (0-based), 0 where static; in masks without a folder of them, all is one.

    Raises:
        InputError: if the file is missing or cannot be decoded, or as `read_mask`.
    """
    path = instances_path(folder, frames.numbers[k])
    if not path.parent.is_dir():
        return read_mask(folder, frames, k).astype(np.uint16)
    if not path.is_file():
        raise InputError(path, "the instances of a frame", "nothing there", ADVICE)
    return images.read_numbers(path)


def read_masks(folder: Path, frames: Sequence) -> dict[int, np.ndarray]:
    """The masks [H, W] bool of all frames by frame number; raises as `read_mask`."""
    return {number: read_mask(folder, frames, k) for k, number in enumerate(frames.numbers)}


def read_masks_on_grid(folder: Path, frames: Sequence, chosen: Iterable[int], size: tuple[int, int]) -> np.ndarray:
    """The masks [F, h, w] bool of the `chosen` frames (0-based) on a `reduced_size` (w, h); raises as `read_mask`.

    A pixel of the grid is dynamic if more than half of what it covers is.
    """
    shares = (images.reduce(read_mask(folder, frames, k).astype(np.float32), size) for k in chosen)
    return np.stack([share > 0.5 for share in shares])
