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
    """Frames [T, h, w, 3] uint8 brought to size (w, h), each pixel the mean of those that it covers.

    Raises:
        InputError: as `read_rgb`.
    """
    return np.stack(threaded(lambda path: cv2.resize(read_rgb(path), size, interpolation=cv2.INTER_AREA), paths))


def read_mask(path: Path) -> np.ndarray:
    """A mask file as [H, W] bool, true where the value is above 127."""
    return np.asarray(_decode(path, cv2.IMREAD_GRAYSCALE) > 127)


def write_image(path: Path, image: np.ndarray) -> None:
    """Write [H, W, 3] RGB or [H, W] grey, uint8 (bool becomes 0 / 255), as PNG or what the suffix says."""
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
