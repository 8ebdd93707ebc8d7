"""Image files as RGB arrays; OpenCV's BGR order stays inside this module."""

import os
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from stages.shared.artifacts import atomic
from stages.shared.errors import InputError
from stages.shared.threads import threaded

cv2.setNumThreads(int(os.environ["OMP_NUM_THREADS"]))


def read_rgb(path: Path) -> np.ndarray:
    """A frame as [H, W, 3] uint8 RGB.

    Stated conversions: grey is repeated over the channels, alpha is dropped, 16 bits are divided by 257.

    Raises:
        InputError: if the file cannot be decoded.
    """
    image = _decode(path, cv2.IMREAD_UNCHANGED)
    if image.dtype == np.uint16:
        image = np.round(image / 257).astype(np.uint8)
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., 2::-1])


def read_reduced(paths: Sequence[Path], size: tuple[int, int]) -> np.ndarray:
    """Frames [T, h, w, 3] uint8 on a `reduced_size` (w, h), each pixel the mean of those that it covers.

    Raises:
        InputError: as `read_rgb`.
    """
    return np.stack(threaded(lambda path: reduce(read_rgb(path), size), paths))


def reduced_size(width: int, height: int, max_width: int) -> tuple[int, int]:
    """Size (w, h) of a frame reduced to at most `max_width`, of which rows that it fills in part are no part."""
    w = min(width, max_width)
    return w, max(1, height * w // width)


def reduce(image: np.ndarray, size: tuple[int, int], interpolation: int = cv2.INTER_AREA) -> np.ndarray:
    """An image [H, W, ...] on its `reduced_size` (w, h), pixel u at (u + 0.5) W / w - 0.5 of it, v alike.

    Both axes have one scale, so that square pixels stay square: 854 x 480 px become 512 x 287, and the last 1.3 rows
    are cut off. (Resized to 512 x 288, as OpenCV does, the lower edge would lie 0.4 px beside where the scale says.)
    """
    scale = size[0] / image.shape[1]
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=interpolation)[: size[1]])


def enlarge(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Values [h, w, ...] of a reduced frame, float, at the pixels of the whole one of size (W, H): linear between them.

    The inverse of `reduce`; rows that it cut off repeat the last one.
    """
    scale = size[0] / image.shape[1]
    grown = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)[: size[1]]
    return np.asarray(cv2.copyMakeBorder(grown, 0, size[1] - len(grown), 0, 0, cv2.BORDER_REPLICATE))


def numbered_frames(folder: Path) -> dict[int, Path]:
    """The files frame_0001.png, ... of a folder by frame number, in order; none where there is no folder."""
    found = {int(path.stem.removeprefix("frame_")): path for path in folder.glob("frame_*.png")}
    return dict(sorted(found.items()))


def read_mask(path: Path) -> np.ndarray:
    """A mask file as [H, W] bool, true where the value is above 127."""
    return np.asarray(_decode(path, cv2.IMREAD_GRAYSCALE) > 127)


def read_numbers(path: Path) -> np.ndarray:
    """A file of whole numbers as [H, W] uint16."""
    return _decode(path, cv2.IMREAD_UNCHANGED).astype(np.uint16)


def write_image(path: Path, image: np.ndarray) -> None:
    """Write [H, W, 3] RGB or [H, W] grey, uint8 (bool becomes 0 / 255) or uint16, as PNG or what the suffix says."""
    if image.dtype == bool:
        image = image.astype(np.uint8) * 255
    ok, encoded = cv2.imencode(path.suffix, image[..., ::-1] if image.ndim == 3 else image)
    if not ok:
        raise ValueError(f"cannot encode {path.name}: shape {image.shape}, {image.dtype}")
    with atomic(path) as partial:
        partial.write_bytes(encoded.tobytes())


def write_figure(path: Path, image: np.ndarray) -> None:
    """Write a picture for the report, [H, W, 3] uint8 RGB, as PNG with a palette: a quarter of the bytes."""
    # 256 colours from an octree are nearer than 96 by median cut, in a fortieth of the time.
    coloured = Image.fromarray(image).quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    with atomic(path) as partial:
        coloured.save(partial, "PNG")


def _decode(path: Path, mode: int) -> np.ndarray:
    content = np.fromfile(path, np.uint8)
    image = cv2.imdecode(content, mode) if len(content) else None
    if image is None:
        raise InputError(path, "a readable image", "one that cannot be decoded", "replace the file")
    return np.asarray(image)


def to_uint8(image: np.ndarray) -> np.ndarray:
    """[..., 3] float 0..1 (clipped) to uint8."""
    return np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)
