"""Depth that the user hands in: one map per frame, its unknown pixels, and how well it agrees with measured depth."""

import json
from collections.abc import Sequence as Listed
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from stages.given import files
from stages.given.arrays import check_size, read_array, read_confidence
from stages.shared import sintel
from stages.shared.errors import InputError
from stages.shared.sequences import Sequence

SUFFIXES = (".dpt", ".png", ".npy")
SCALE_FILES = ("scale.json", "depth.json")
"""Beside 16-bit PNG: {"scale": scene units per step}. Our export writes the first name."""
OPTION = "ba.depth_from"
CONFIDENT = 0.5
"""Depths of a smaller confidence are not used."""


@dataclass(frozen=True)
class GivenDepth:
    """Depth of a sequence, read one by one: [T] files, size (width, height), and the units of a step of PNG files."""

    paths: Listed[Path]
    size: tuple[int, int]
    scale: float

    def inverse(self, k: int) -> np.ndarray:
        """The inverse depth of frame k (0-based) [H, W] float64: 0 where infinitely far, NaN where it is not known.

        Depths of 0, below 0 and NaN are not known; nor are those of a confidence below one half.

        Raises:
            InputError: for a file of another format or size, or without any depth.
        """
        path = self.paths[k]
        depth = read_depth(path, self.scale)
        check_size(path, depth.shape[::-1], self.size)
        known = depth > 0
        if (beside := files.confidence_file(path)) is not None:
            known &= read_confidence(beside, self.size) >= CONFIDENT
        if not known.any():
            raise InputError(path, "a depth above 0", "none", "leave out maps without depth, or write z-depth")
        return np.where(known, 1 / np.where(known, depth, 1), np.nan)


def find_depths(folder: Path, frames: Sequence) -> list[Path]:
    """The depth map of every frame [T].

    Raises:
        InputError: if a frame has none, if there are maps of several formats, or 16-bit PNG without their scale.
    """
    candidates = files.listed(folder, SUFFIXES, "depth maps", OPTION)
    kinds = sorted({path.suffix.lower() for path in candidates})
    if len(kinds) > 1:
        raise InputError(folder, "depth maps of one format", " and ".join(kinds), "keep those of one format there")
    if kinds == [".png"]:
        read_scale(folder)
    return files.by_frame(candidates, frames.frames, frames.numbers, "depth maps")


def open_depths(folder: Path, frames: Sequence) -> GivenDepth:
    """The depth maps of a sequence; raises as `find_depths`."""
    paths = find_depths(folder, frames)
    return GivenDepth(paths, (frames.width, frames.height), read_scale(folder) if paths[0].suffix == ".png" else 1.0)


def read_scale(folder: Path) -> float:
    """Scene units per step of 16-bit PNG in a folder.

    Raises:
        InputError: if no file says it.
    """
    advice = 'write depth.json with {"scale": units per step}: 0.00390625 for KITTI\'s 1/256 m, 0.001 for millimetres'
    for path in (folder / name for name in SCALE_FILES):
        if path.is_file():
            try:
                scale = float(json.loads(path.read_text())["scale"])
            except (ValueError, KeyError, TypeError) as error:
                raise InputError(path, '{"scale": a number}', "something else", advice) from error
            if not 0 < scale < np.inf:
                raise InputError(path, "a scale above 0", f"{scale}", advice)
            return scale
    raise InputError(folder, f"{' or '.join(SCALE_FILES)} beside 16-bit PNG of depth", "neither", advice)


def read_depth(path: Path, scale: float) -> np.ndarray:
    """A depth map [H, W] float64 in scene units, with whatever it holds where depth is not known.

    Args:
        scale: units per step of a 16-bit PNG.

    Raises:
        InputError: for another format.
    """
    if path.suffix.lower() == ".dpt":
        return sintel.read_dpt(path).astype(float)
    if path.suffix.lower() == ".npy":
        return read_array(path, "depth [height, width]", 2)
    values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if values is None or values.dtype != np.uint16 or values.ndim != 2:
        found = "a file that cannot be decoded" if values is None else f"{values.dtype} {list(values.shape)}"
        raise InputError(path, "a 16-bit grey PNG of depth", found, "write 16 bits, .npy or .dpt")
    return values * scale
