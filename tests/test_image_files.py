"""Frames as cameras, phones and tools write them: what is read of them, and what is refused or said."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import write_frames
from PIL import Image

from stages.export.__main__ import _write_frame
from stages.inspect import __main__ as inspect_stage
from stages.inspect.options import PartOptions
from stages.shared.dataset_folders import frame_files, sequence_folders, video_files
from stages.shared.errors import InputError
from stages.shared.image_headers import ORIENTATION
from stages.shared.images import read_rgb, reduced_size, relative_size
from stages.shared.sequences import check_sequence, read_sequence

SMOOTH = cv2.resize(np.random.default_rng(2).integers(0, 255, (6, 8, 3), np.uint8), (64, 48))


@pytest.mark.parametrize(
    ("image", "told"),
    [
        (np.full((48, 64), 77, np.uint8), "grey frames are used as RGB"),
        (np.full((48, 64), 77 * 257, np.uint16), "16-bit frames are reduced to 8 bits"),
        (np.full((48, 64, 3), 77 * 257, np.uint16), "16-bit frames are reduced to 8 bits"),
        (
            np.full((48, 64, 4), 77 * 257, np.uint16),
            "reduced to 8 bits; the alpha channel is dropped",
        ),
        (np.full((48, 64, 4), 77, np.uint8), "the alpha channel is dropped"),
    ],
)
def test_stated_conversions_of_odd_images(tmp_path: Path, image: np.ndarray, told: str) -> None:
    for number in range(1, 4):
        cv2.imwrite(str(tmp_path / f"frame_{number:04d}.png"), image)
    sequence = check_sequence("odd", tmp_path)
    assert any(told in warning for warning in sequence.warnings)
    rgb = read_rgb(sequence.frames[0])
    assert rgb.shape == (48, 64, 3)
    assert np.all(rgb == 77)


def test_frames_that_repeat_the_one_before_are_named(tmp_path: Path) -> None:
    folder = write_frames(tmp_path / "clip", count=8, size=(72, 96))
    for number in (2, 3, 6):
        shutil.copy(folder / f"frame_{number - 1:04d}.png", folder / f"frame_{number:04d}.png")
    inspect_stage.main(folder, tmp_path / "sequence.json", tmp_path / "inspect.png", PartOptions(burnt_in="no"))
    (said,) = [warning for warning in read_sequence(tmp_path / "sequence.json").warnings if "repeat" in warning]
    assert said.startswith("frames 2-3, 6 repeat the one before")


def test_colours_of_eight_bits_need_no_word(tmp_path: Path) -> None:
    assert not check_sequence("clip", write_frames(tmp_path, size=(72, 96))).warnings


@pytest.mark.parametrize(
    ("orientation", "shown"),
    [
        (1, lambda image: image),
        (2, lambda image: image[:, ::-1]),
        (3, lambda image: image[::-1, ::-1]),
        (6, lambda image: np.rot90(image, -1)),
        (8, lambda image: np.rot90(image)),
    ],
)
def test_photographs_are_turned_as_their_exif_data_ask(tmp_path: Path, orientation: int, shown: object) -> None:
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    for number in range(1, 4):
        Image.fromarray(SMOOTH).save(tmp_path / f"IMG_{number}.jpg", quality=98, exif=exif)
    sequence = check_sequence("clip", tmp_path)
    found, wanted = read_rgb(sequence.frames[0]), np.ascontiguousarray(shown(SMOOTH))  # type: ignore[operator]
    assert (sequence.height, sequence.width) == found.shape[:2] == wanted.shape[:2]
    assert cv2.PSNR(found, wanted) > 30


def test_what_is_exported_needs_no_turn(tmp_path: Path) -> None:
    """Readers of the export may turn it by its EXIF data or not: it has none."""
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    turned, plain = tmp_path / "turned.jpg", tmp_path / "plain.jpg"
    Image.fromarray(SMOOTH).save(turned, quality=98, exif=exif)
    Image.fromarray(SMOOTH).save(plain, quality=98)
    for path in (turned, plain):
        _write_frame(path, tmp_path / "exported.jpg")
        with Image.open(tmp_path / "exported.jpg") as image:
            assert image.size == read_rgb(path).shape[1::-1]
            assert image.getexif().get(ORIENTATION, 1) == 1
    assert (tmp_path / "exported.jpg").read_bytes() == plain.read_bytes()


def test_other_metadata_than_exif_turn_nothing(tmp_path: Path) -> None:
    """The decoder knows nothing of them."""
    said = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><r tiff:Orientation="6"/></x:xmpmeta>'
    segment = b"http://ns.adobe.com/xap/1.0/\0" + said
    for path in sorted(write_jpegs(tmp_path).parent.glob("*.jpg")):
        whole = path.read_bytes()
        path.write_bytes(whole[:2] + b"\xff\xe1" + (2 + len(segment)).to_bytes(2, "big") + segment + whole[2:])
    sequence = check_sequence("clip", tmp_path)
    assert (sequence.height, sequence.width) == read_rgb(sequence.frames[0]).shape[:2] == (48, 64)


def write_jpegs(folder: Path, before: bytes = b"") -> Path:
    """Three frames, each with `before` and a thumbnail before its picture, and the last of them."""
    _, thumbnail = cv2.imencode(".jpg", SMOOTH[:8, :8])
    segment = b"Exif\0\0" + thumbnail.tobytes()
    for number in range(1, 4):
        _, image = cv2.imencode(".jpg", SMOOTH)
        whole = image.tobytes()
        inserted = before + b"\xff\xe1" + (2 + len(segment)).to_bytes(2, "big") + segment
        (folder / f"frame_{number:04d}.jpg").write_bytes(whole[:2] + inserted + whole[2:])
    return folder / "frame_0003.jpg"


@pytest.mark.parametrize("share", [0.9, 0.98])
@pytest.mark.parametrize("before", [b"", b"\xff\xff", b"\xff\xfe\0\5ok!"], ids=["plain", "padding", "a comment"])
def test_a_truncated_jpeg_is_refused(tmp_path: Path, before: bytes, share: float) -> None:
    last = write_jpegs(tmp_path, before)
    last.write_bytes(last.read_bytes()[: int(share * last.stat().st_size)])
    with pytest.raises(InputError, match=r"frame_0003\.jpg: expected a complete image, found one that ends too early"):
        check_sequence("clip", tmp_path)


@pytest.mark.parametrize("before", [b"", b"\xff\xff", b"\xff\xfe\0\5ok!"], ids=["plain", "padding", "a comment"])
def test_a_jpeg_with_a_film_behind_it_is_complete(tmp_path: Path, before: bytes) -> None:
    """As phones write them: a moving picture follows the one that stands still."""
    last = write_jpegs(tmp_path, before)
    last.write_bytes(last.read_bytes() + bytes(5000))
    assert len(check_sequence("clip", tmp_path).frames) == 3
    assert np.array_equal(read_rgb(last), read_rgb(tmp_path / "frame_0001.jpg"))


def test_the_format_is_that_of_the_content(tmp_path: Path) -> None:
    write_jpegs(tmp_path)
    for path in sorted(tmp_path.glob("*.jpg")):
        path.rename(path.with_suffix(".png"))
    assert len(check_sequence("clip", tmp_path).frames) == 3
    Image.fromarray(SMOOTH).save(tmp_path / "frame_0003.png", "WEBP")
    with pytest.raises(InputError, match=r"frame_0003\.png: expected a PNG or JPEG.*, found one of the format WEBP"):
        check_sequence("clip", tmp_path)


def test_what_is_hidden_is_no_frame_no_video_and_no_sequence(tmp_path: Path) -> None:
    """macOS writes ._frame_0001.png beside frame_0001.png on a stick; galleries keep .thumbs."""
    folder = write_frames(tmp_path / "data" / "clip")
    write_frames(tmp_path / "data" / ".thumbs")
    (folder / "._frame_0003.png").write_bytes(b"\0" * 200)
    assert len(frame_files(folder)) == len(check_sequence("clip", folder).frames) == 4
    assert list(sequence_folders(tmp_path / "data", "final")) == ["clip"]
    (tmp_path / "videos").mkdir()
    for name in ("IMG_1.MOV", "._IMG_1.MOV"):
        (tmp_path / "videos" / name).write_bytes(b"\0" * 200)
    assert list(video_files(tmp_path / "videos")) == ["IMG_1"]


@pytest.mark.parametrize(
    ("size", "reduced"),
    [((854, 480), (512, 287)), ((480, 854), (287, 510)), ((1080, 1920), (288, 512)), ((300, 160), (300, 160))],
)
def test_frames_are_reduced_by_their_longer_side(size: tuple[int, int], reduced: tuple[int, int]) -> None:
    """An upright frame keeps as many pixels as the same one held across, and square ones."""
    assert reduced_size(*size, 512) == reduced
    w, h = reduced
    assert 0 <= size[1] * w / size[0] - h < 1
    assert relative_size(np.zeros((h, w, 3))) == relative_size(np.zeros((w, h))) == max(reduced) / 512
