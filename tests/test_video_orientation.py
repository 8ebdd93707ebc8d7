"""Videos are shown as a player shows them: turned and mirrored as their display matrix asks."""

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from encoded_video import encode, moving
from test_video import decoded, indexed, psnr


@pytest.mark.parametrize("turn_deg", [90, 180, -90])
def test_rotation_in_the_metadata_is_carried_out(tmp_path: Path, turn_deg: int) -> None:
    images = moving(4)
    video = encode(tmp_path / "clip.mp4", images, rotation_deg=turn_deg)
    upright = [np.rot90(image, turn_deg // 90).copy() for image in images]
    assert psnr(decoded(video, tmp_path), upright) > 38
    index = indexed(video)
    assert (index.width, index.height) == upright[0].shape[1::-1]


def test_a_video_held_upright_is_reduced_by_its_height(tmp_path: Path) -> None:
    """It has as many pixels then as one held across, and both have square ones."""
    images = moving(4)
    across = indexed(encode(tmp_path / "across.mp4", images), max_side=64)
    upright = indexed(encode(tmp_path / "upright.mp4", images, rotation_deg=90), max_side=64)
    assert (across.width, across.height) == (64, 42)
    assert (upright.width, upright.height) == (42, 63)


def with_matrix(video: Path, *matrix: float) -> Path:
    """The MP4 file with this display matrix a, b, c, d.

    ISO 14496-12, track header: x' = a x + c y, y' = b x + d y, in 16.16 bits and the order a, b, u, c, d, v.
    """
    a, b, c, d = (round(65536 * entry) for entry in matrix)
    content = bytearray(video.read_bytes())
    at = content.index(b"tkhd") + 4 + 40  # version 0: 40 bytes before the matrix
    content[at : at + 20] = struct.pack(">5i", a, b, 0, c, d)
    video.write_bytes(content)
    return video


@pytest.mark.parametrize(
    ("matrix", "shown"),
    [
        ((0, 1, -1, 0), lambda image: cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE)),  # a phone held upright
        ((-1, 0, 0, 1), lambda image: cv2.flip(image, 1)),  # a front camera's mirror image
        ((1, 0, 0, -1), lambda image: cv2.flip(image, 0)),
        ((0, 1, 1, 0), cv2.transpose),
        ((0, -1, -1, 0), lambda image: cv2.flip(cv2.transpose(image), -1)),
        ((1, 5e-5, -5e-5, 1), np.copy),  # rounded
        ((-5e-5, 1, -1, -5e-5), lambda image: cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE)),
    ],
)
def test_a_matrix_turns_and_mirrors(tmp_path: Path, matrix: tuple[float, ...], shown: Any) -> None:
    images = moving(4)
    video = with_matrix(encode(tmp_path / "clip.mp4", images), *matrix)
    truth = [shown(image) for image in images]
    assert psnr(decoded(video, tmp_path), truth) > 38
    index = indexed(video)
    assert (index.width, index.height) == truth[0].shape[1::-1]


def test_a_turn_that_is_no_quarter_is_left_out_and_told(tmp_path: Path) -> None:
    images, (c, s) = moving(4), (np.cos(0.5), np.sin(0.5))
    video = with_matrix(encode(tmp_path / "clip.mp4", images), c, s, -s, c)
    assert psnr(decoded(video, tmp_path), images) > 38
    assert any("which is left out" in warning for warning in indexed(video).warnings)
