"""Masks that the user hands in: one PNG per frame, binary or with a number per instance."""

from collections.abc import Sequence as Listed
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from stages.given import files
from stages.given.arrays import check_size
from stages.shared.errors import InputError
from stages.shared.log import logger
from stages.shared.sequences import Sequence
from stages.shared.threads import threaded

SUFFIXES = (".png",)
OPTION = "segment.source"
BINARY, INSTANCES, BLACK_MOVES = "binary", "instances", "binary, black moves"
LEVELS = 2**16
SHARP_SHARE, FEW_VALUES = 0.95, 8
"""More than so many values of 8 bits are a binary mask with soft borders if at least this share of the pixels is 0 or
255, and most of the others 255: masks that were resized."""
MOST_INSTANCES = 64
"""More values than this in 8 bits are shades of grey and no numbers."""
MOST_DYNAMIC = 0.85
"""Masks over a larger share of the clip leave too little static area for the poses."""
USUAL_DYNAMIC = 0.5
"""Above this share a warning says so: masks may be inverted."""


@dataclass(frozen=True)
class GivenMasks:
    """Masks of a sequence, read one by one.

    Attributes:
        paths: [T] files; size: (width, height).
        kind: "binary", "instances", or "binary, black moves" for masks in COLMAP's naming.
        threshold: of binary masks: larger values are white.
        share: of the pixels of the clip that move.
    """

    paths: Listed[Path]
    size: tuple[int, int]
    kind: str
    threshold: int
    share: float

    def labels(self, k: int) -> np.ndarray:
        """The mask of frame k (0-based) [H, W] uint16: 0 where static, else 1 or the number of the instance."""
        values = read_values(self.paths[k], self.size)
        if self.kind == INSTANCES:
            return values
        return np.asarray((values > self.threshold) != (self.kind == BLACK_MOVES), np.uint16)


def find_masks(folder: Path, frames: Sequence, option: str = OPTION) -> list[Path]:
    """The mask of every frame [T] in a folder that an option names; raises InputError if a frame has none."""
    candidates = files.listed(folder, SUFFIXES, "masks", option)
    return files.by_frame(candidates, frames.frames, frames.numbers, "masks")


def read(paths: Listed[Path], frames: Sequence) -> GivenMasks:
    """The masks of all frames, checked: what is not 0 moves; in COLMAP's naming (`frame_0001.png.png`), what is 0.

    Raises:
        InputError: for a file that is no grey or palette PNG, for another size than that of the frames, for shades of
            grey, and for masks over nearly the whole clip.
    """
    size = frames.width, frames.height
    counts = np.zeros(LEVELS, np.int64)
    for found in threaded(lambda path: np.bincount(read_values(path, size).ravel(), minlength=LEVELS), paths):
        counts += found
    folder, inverted = paths[0].parent, files.is_colmap_named(paths[0], frames.frames[0].suffix)
    kind, threshold = interpreted(counts, folder, inverted)
    white = float(counts[threshold + 1 :].sum() / counts.sum())
    share = 1 - white if inverted else white
    if share > MOST_DYNAMIC:
        expected = f"masks that mark what moves, at most {MOST_DYNAMIC:.0%} of all pixels"
        how = " by black, as in COLMAP's masks," if inverted else ""
        raise InputError(folder, expected, f"{share:.0%} marked{how}", "invert them if they mark what is static")
    if share > USUAL_DYNAMIC:
        told = "%s: the given masks mark %.0f %% of the pixels as moving: invert them if they mark what is static"
        logger.warning(told, frames.name, 100 * share)
    return GivenMasks(paths, size, kind, threshold, share)


def read_values(path: Path, size: tuple[int, int]) -> np.ndarray:
    """The values [H, W] of a mask: grey levels, or the numbers of a palette's colours.

    Args:
        size: (width, height) of the frames.

    Raises:
        InputError: as `read`.
    """
    try:
        with Image.open(path) as image:
            mode, values = image.mode, np.array(image)
    except (UnidentifiedImageError, OSError, SyntaxError) as error:
        raise InputError(path, "a PNG of a mask", "a file that cannot be decoded", "replace the file") from error
    check_size(path, values.shape[1::-1], size)
    if values.ndim == 3:
        grey = values[..., :1]
        if mode not in ("RGB", "RGBA", "LA") or (values[..., : 3 if mode != "LA" else 1] != grey).any():
            raise InputError(path, "a grey or palette PNG", "colours", "write one number per pixel")
        values = grey[..., 0]
    if values.min() < 0 or values.max() > LEVELS - 1:
        raise InputError(path, "numbers in 0..65535", f"{values.min()}..{values.max()}", "number the instances anew")
    return values.astype(np.uint16)


def interpreted(counts: np.ndarray, folder: Path, inverted: bool) -> tuple[str, int]:
    """The kind of masks and their threshold, from the number of pixels of each value [LEVELS] over the clip.

    Args:
        folder: named in the error. inverted: whether black marks what moves.

    Raises:
        InputError: for shades of grey that are neither a binary mask nor numbers.
    """
    used = np.flatnonzero(counts[1:]) + 1
    eight_bits = len(used) > 0 and used[-1] <= 255
    sharp = counts[0] + counts[255] >= SHARP_SHARE * counts.sum() and counts[255] > 0.5 * counts[1:].sum()
    resized = eight_bits and len(used) > FEW_VALUES and sharp
    if eight_bits and len(used) > MOST_INSTANCES and not resized:
        expected, found = "masks of 0 and 255, or a number per instance", f"{len(used)} shades of grey"
        raise InputError(folder, expected, found, "write 255 where they exceed 127")
    if inverted:
        return BLACK_MOVES, 127 if resized else 0
    if len(used) > 1 and not resized:
        return INSTANCES, 0
    return BINARY, 127 if resized else 0
