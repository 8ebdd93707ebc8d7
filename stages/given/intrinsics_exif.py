"""Focal lengths from the EXIF data of image files (CIPA DC-008, Exif 2.32)."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from stages.shared.errors import InputError
from stages.shared.sequences import Sequence

EXIF_IFD = 0x8769
FOCAL_MM, FOCAL_35MM, WIDTH, HEIGHT = 0x920A, 0xA405, 0xA002, 0xA003
PLANE_RESOLUTION, PLANE_UNIT = 0xA20E, 0xA210
UNITS_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
"""Lengths in which FocalPlaneResolutionUnit counts pixels: inch, cm, mm, um."""
FILM_DIAGONAL_MM = float(np.hypot(36, 24))
"""FocalLengthIn35mmFilm is that of the same field of view along the diagonal (CIPA DCG-001)."""
ONE_FOCAL = 0.01
"""Relative range of the frames' focal lengths up to which they count as one."""


def focal_px(tags: Mapping[int, Any], width: int, height: int) -> float | None:
    """Focal length in px of a frame of width x height px with these tags of the Exif IFD; None if they do not say.

    FocalLengthIn35mmFilm is preferred; else FocalLength, with the pixels per length on the focal plane.
    """
    equivalent = _positive(tags.get(FOCAL_35MM))
    if equivalent:
        return equivalent * float(np.hypot(width, height)) / FILM_DIAGONAL_MM
    focal_mm, resolution = _positive(tags.get(FOCAL_MM)), _positive(tags.get(PLANE_RESOLUTION))
    if not focal_mm or not resolution:
        return None
    wide_px, high_px = _positive(tags.get(WIDTH)) or width, _positive(tags.get(HEIGHT))
    # The picture may have been resized since, and be shown with rows for columns.
    resized = max(width, height) / max(wide_px, high_px) if high_px else width / wide_px
    unit_mm = UNITS_MM.get(int(tags.get(PLANE_UNIT, 2)), UNITS_MM[2])
    return focal_mm * resolution / unit_mm * resized


def focal_of_frames(frames: Sequence) -> float:
    """Focal length in px of the frames, from the EXIF data of all of them.

    Raises:
        InputError: for frames of a video or without EXIF data, and for a focal length that changes.
    """
    advice = "give `intrinsics:` in px or mm, or estimate"
    if frames.times_s is not None:
        raise InputError(frames.frames[0].parent, "frames with EXIF data", "frames of a video, which have none", advice)
    found = list(_focals(frames.frames, frames.width, frames.height))
    for path, focal in zip(frames.frames, found, strict=True):
        if focal is None:
            expected = "EXIF data with FocalLengthIn35mmFilm, or FocalLength and FocalPlaneXResolution"
            raise InputError(path, expected, "none", advice)
    known = np.array(found, float)
    if np.ptp(known) > ONE_FOCAL * known.min():
        where = frames.frames[int(np.argmax(np.abs(known - known[0])))]
        raise InputError(where, f"{known[0]:.0f} px as in the first frame", f"{known.max():.0f} px", "estimate it")
    return float(np.median(known))


def _focals(paths: Iterable[Path], width: int, height: int) -> Iterable[float | None]:
    for path in paths:
        with Image.open(path) as image:
            yield focal_px(image.getexif().get_ifd(EXIF_IFD), width, height)


def _positive(value: Any) -> float | None:
    """A tag's number if it is above 0; None for a missing one and a ratio over zero."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if np.isfinite(number) and number > 0 else None
