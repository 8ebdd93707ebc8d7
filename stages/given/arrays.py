"""Arrays in files that the user hands in: their size, and confidences beside depth and flow."""

from pathlib import Path

import cv2
import numpy as np

from stages.shared.errors import InputError


def check_size(path: Path, found: tuple[int, int], size: tuple[int, int]) -> None:
    """Refuse a file of another size (width, height) than the frames; the line says whether the shape is the same.

    Raises:
        InputError: if the sizes differ.
    """
    if found == size:
        return
    (w, h), (W, H) = found, size
    scaled = abs(w / W - h / H) * max(W, H) <= 1
    kind = f"{w} x {h}, the frames scaled by {w / W:.3g}" if scaled else f"{w} x {h}, another shape"
    advice = "hand in files at the size of the frames" if scaled else "hand in files that belong to these frames"
    raise InputError(path, f"{W} x {H} like the frames", kind, advice)


def read_array(path: Path, expected: str, dimensions: int) -> np.ndarray:
    """An array of numbers from .npy, float64, without axes of length 1 in excess.

    Args:
        expected: in words; dimensions: the number of its axes.

    Raises:
        InputError: for a file that is no such array.
    """
    try:
        values = np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise InputError(path, f"an array of {expected}", "no .npy of numbers", "write it again") from error
    while values.ndim > dimensions and 1 in values.shape:
        values = values.squeeze(values.shape.index(1))
    if values.ndim != dimensions or values.dtype.kind not in "fiu":
        raise InputError(path, f"an array of {expected}", f"{list(values.shape)} of {values.dtype}", "write it again")
    return np.asarray(values, float)


def read_confidence(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Confidence [H, W] in 0..1: an array of numbers in .npy, or 8-bit grey PNG, of which 255 is 1.

    Args:
        size: (width, height) of the frames.

    Raises:
        InputError: for another format, size or range.
    """
    if path.suffix.lower() == ".npy":
        values = read_array(path, "confidence [height, width]", 2)
    else:
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if image is None or image.dtype != np.uint8 or image.ndim != 2:
            raise InputError(path, "an 8-bit grey PNG of confidence", "another kind of file", "write .npy in 0..1")
        values = image / 255.0
    check_size(path, (values.shape[1], values.shape[0]), size)
    if not (values.min() >= 0 and values.max() <= 1):
        raise InputError(path, "confidence in 0..1", f"{values.min():g}..{values.max():g}", "divide by its maximum")
    return values
