"""Image files as RGB arrays; OpenCV's BGR order stays inside this module."""

import os
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from stages.shared.atomic import atomic
from stages.shared.errors import InputError
from stages.shared.threads import threaded

cv2.setNumThreads(int(os.environ["OMP_NUM_THREADS"]))
START_OF_JPEG = b"\xff\xd8"
DISPLAY_GAMMA = 2.2
"""Power that stands for the curve of the display where fog is fitted and drawn, which must agree."""
REFERENCE_PX = 512
"""Longer side of frames for which lengths in pixels are stated."""


def read_rgb(path: Path) -> np.ndarray:
    """A frame as [H, W, 3] uint8 RGB.

    Grey frames are repeated over the channels, alpha is dropped, and 16-bit values are divided by 257. JPEG files are
    turned as their EXIF data ask.

    Raises:
        InputError: if the file cannot be decoded.
    """
    image = _decode(path, cv2.IMREAD_UNCHANGED, of_jpeg=cv2.IMREAD_COLOR)  # the first of these turns nothing
    if image.dtype == np.uint16:
        image = np.round(image / 257).astype(np.uint8)
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., 2::-1])


def read_reduced(paths: Sequence[Path], size: tuple[int, int]) -> np.ndarray:
    """Frames [T, h, w, 3] uint8 RGB at a `reduced_size` (w, h); each pixel is the mean of the area that it covers.

    Raises:
        InputError: if a file cannot be decoded.
    """
    return np.stack(threaded(lambda path: reduce(read_rgb(path), size), paths))


def relative_size(image: np.ndarray) -> float:
    """Longer side of an image [h, w, ...] over that of frames for which lengths in pixels are stated."""
    return max(image.shape[:2]) / REFERENCE_PX


def reduced_size(width: int, height: int, max_side: int) -> tuple[int, int]:
    """Size (w, h) of a frame with a longer side of at most `max_side` px, without a last row that it fills in part."""
    w = min(width, max(1, width * max_side // max(width, height)))
    return w, max(1, height * w // width)


def reduce(image: np.ndarray, size: tuple[int, int], interpolation: int = cv2.INTER_AREA) -> np.ndarray:
    """An image [H, W, ...] reduced to its `reduced_size` (w, h).

    Pixel (u, v) lies at ((u + 0.5) s - 0.5, (v + 0.5) s - 0.5) of the image, with s = W / w for both axes, so that
    square pixels stay square. 854 x 480 px become 512 x 287, and the last 1.3 rows are cut off. (OpenCV's 512 x 288
    would have another scale vertically, with an error of 0.4 px at the lower edge.)
    """
    scale = size[0] / image.shape[1]
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=interpolation)[: size[1]])


def enlarge(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Float values [h, w, ...] of a reduced frame, interpolated linearly at the pixels of the whole frame (W, H).

    The inverse of `reduce`; rows that it cut off repeat the last one.
    """
    scale = size[0] / image.shape[1]
    grown = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)[: size[1]]
    return np.asarray(cv2.copyMakeBorder(grown, 0, size[1] - len(grown), 0, 0, cv2.BORDER_REPLICATE))


def numbered_frames(folder: Path) -> dict[int, Path]:
    """The files frame_0001.png, ... of a folder by frame number, in order; empty if the folder does not exist."""
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
    """Write a picture for the report, [H, W, 3] uint8 RGB, as PNG with a palette, which makes the file smaller."""
    # 256 colours from an octree are closer to the image than 96 by median cut, and much faster to find.
    coloured = Image.fromarray(image).quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    with atomic(path) as partial:
        coloured.save(partial, "PNG")


def _decode(path: Path, mode: int, of_jpeg: int | None = None) -> np.ndarray:
    """An image file in a mode of OpenCV, or, if that is stated, in another one for JPEG files."""
    content = np.fromfile(path, np.uint8)
    if of_jpeg is not None and content[:2].tobytes() == START_OF_JPEG:
        mode = of_jpeg
    image = cv2.imdecode(content, mode) if len(content) else None
    if image is None:
        raise InputError(path, "a readable image", "one that cannot be decoded", "replace the file")
    return np.asarray(image)


def to_uint8(image: np.ndarray) -> np.ndarray:
    """Colours [..., 3] float in 0..1 (clipped) as uint8 in 0..255."""
    return np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)
