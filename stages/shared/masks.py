"""Masks: of what moves, a folder that the segment stage writes, and of what is burnt into all frames, one image.

Of the former there is one PNG per frame, 255 where something moves.

Beside them, the instances: what is connected over space and time has one number through the clip.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from stages.shared import images
from stages.shared.errors import InputError
from stages.shared.frame_store import PackedMasks
from stages.shared.sequences import Sequence
from stages.shared.warp import warp

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
    return read_sized_mask(mask_path(folder, frames.numbers[k]), (frames.width, frames.height), ADVICE)


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


def read_masks(folder: Path, frames: Sequence) -> PackedMasks:
    """The masks [H, W] bool of all frames by frame number; raises as `read_mask`."""
    return PackedMasks((number, read_mask(folder, frames, k)) for k, number in enumerate(frames.numbers))


def read_masks_on_grid(folder: Path, frames: Sequence, chosen: Iterable[int], size: tuple[int, int]) -> np.ndarray:
    """The masks [F, h, w] bool of the `chosen` frames (0-based) on a `reduced_size` (w, h); raises as `read_mask`.

    A pixel of the grid is dynamic if more than half of what it covers is.
    """
    shares = (images.reduce(read_mask(folder, frames, k).astype(np.float32), size) for k in chosen)
    return np.stack([share > 0.5 for share in shares])


def read_burnt_in(frames: Sequence) -> np.ndarray | None:
    """Pixels [H, W] bool of logos, time codes and bars, which show no part of the scene; None if there are none.

    Raises:
        InputError: if the file is missing, cannot be decoded or has another size than the frames.
    """
    if frames.burnt_in is None:
        return None
    return read_sized_mask(frames.burnt_in, (frames.width, frames.height), "run the input check again: -R inspect")


def read_sized_mask(path: Path, size: tuple[int, int], advice: str) -> np.ndarray:
    """A mask [H, W] bool of a given size (W, H).

    Raises:
        InputError: if the file is missing, cannot be decoded or has another size.
    """
    if not path.is_file():
        raise InputError(path, "a mask", "nothing there", advice)
    mask = images.read_mask(path)
    if mask.shape != size[::-1]:
        raise InputError(path, f"{size[0]} x {size[1]}", f"{mask.shape[1]} x {mask.shape[0]}", advice)
    return mask


def read_scene_on_grid(frames: Sequence, size: tuple[int, int]) -> np.ndarray | None:
    """Pixels [h, w] bool of a `reduced_size` (w, h) that show the scene alone; None if nothing is burnt in."""
    burnt_in = read_burnt_in(frames)
    return None if burnt_in is None else images.reduce(burnt_in.astype(np.float32), size) == 0


def within(scene: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """Whether flow [h, w, 2] px begins and ends at pixels of the scene [h, w] bool."""
    return np.asarray(scene & (warp(scene.astype(np.float32), flow) > 0.99))
