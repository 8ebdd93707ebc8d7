"""Focal lengths from EXIF data of photographs, with and without the size of a pixel."""

import struct
from dataclasses import replace
from pathlib import Path

import cv2
import export_clip as truth
import numpy as np
import pytest
from test_given_cameras import FRAMES, NAMES

from stages.given.cameras_files import read_intrinsics
from stages.given.intrinsics_exif import focal_px
from stages.shared.cameras import centred_intrinsics
from stages.shared.errors import InputError


def exif(tags: list[tuple[int, int, bytes]]) -> bytes:
    """An EXIF block: a directory that points to an Exif directory of entries (tag, type, value of 4 or 8 bytes)."""
    start = 8 + 2 + 12 + 4
    entries, values, at = b"", b"", start + 2 + 12 * len(tags) + 4
    for tag, kind, value in tags:
        entries += struct.pack("<HHI", tag, kind, 1) + (
            value if len(value) == 4 else struct.pack("<I", at + len(values))
        )
        values += value if len(value) == 8 else b""
    head = b"II*\0" + struct.pack("<I", 8) + struct.pack("<HHHII", 1, 0x8769, 4, 1, start) + bytes(4)
    return b"Exif\0\0" + head + struct.pack("<H", len(tags)) + entries + bytes(4) + values


def photograph(path: Path, tags: list[tuple[int, int, bytes]]) -> Path:
    """A JPEG of 96 x 64 px with EXIF data."""
    ok, jpeg = cv2.imencode(".jpg", np.zeros((64, 96, 3), np.uint8))
    assert ok
    block = exif(tags)
    segment = b"\xff\xe1" + struct.pack(">H", len(block) + 2) + block
    path.write_bytes(jpeg.tobytes()[:2] + segment + jpeg.tobytes()[2:])
    return path


def short(tag: int, value: int) -> tuple[int, int, bytes]:
    """A whole number."""
    return tag, 3, struct.pack("<HH", value, 0)


def ratio(tag: int, above: int, below: int) -> tuple[int, int, bytes]:
    """A ratio of whole numbers."""
    return tag, 5, struct.pack("<II", above, below)


FILM = [short(0xA405, 28)]
PLANE = [ratio(0x920A, 63, 10), ratio(0xA20E, 4000, 7), short(0xA210, 4), short(0xA002, 4000)]
"""6.3 mm, 4000 px on 7 mm."""


@pytest.mark.parametrize("size", [(96, 64), (64, 96)])
def test_a_picture_that_is_shown_upright_keeps_its_focal_length(size: tuple[int, int]) -> None:
    """The tags count pixels as they were taken, 4000 x 2667; the frame may have been turned, and reduced."""
    tags = {0x920A: 6.3, 0xA20E: 4000 / 7, 0xA210: 4, 0xA002: 4000, 0xA003: 2667}
    assert focal_px(tags, *size) == pytest.approx(6.3 / 7 * 96)


@pytest.mark.parametrize(
    ("tags", "focal_px"),
    [(FILM, 28 * np.hypot(96, 64) / np.hypot(36, 24)), (PLANE, 6.3 / 7 * 96), (FILM + PLANE, 74.67)],
)
def test_focal_lengths_from_exif(tmp_path: Path, tags: list, focal_px: float) -> None:
    paths = [photograph(tmp_path / f"{name[:-4]}.jpg", tags) for name in NAMES]
    frames = replace(FRAMES, frames=paths)
    assert np.allclose(read_intrinsics("exif", frames), centred_intrinsics(focal_px, 96, 64), rtol=1e-3)
    with pytest.raises(InputError, match="found frames of a video, which have none; give `intrinsics:` in px or mm"):
        read_intrinsics("exif", replace(frames, times_s=[float(k) for k in range(truth.T)]))
    photograph(paths[3], [short(0xA405, 56)])
    with pytest.raises(InputError, match=r"frame_0004\.jpg: expected .* px as in the first frame"):
        read_intrinsics("exif", frames)
    photograph(paths[3], [ratio(0x920A, 63, 0)])
    with pytest.raises(InputError, match=r"frame_0004\.jpg: expected EXIF data with FocalLengthIn35mmFilm, or"):
        read_intrinsics("exif", frames)
