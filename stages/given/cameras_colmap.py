"""COLMAP's cameras and images, in text and in binary (https://colmap.github.io/format.html); cam_from_world."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from stages.given.cameras import Lens, pinhole
from stages.given.poses import Poses, from_quats
from stages.shared.colmap_records import CAMERA, COUNT, IMAGE, MODELS, OBSERVATION, CameraModel
from stages.shared.errors import InputError

ADVICE = "write the model again, as by `colmap model_converter`"
BY_NAME = {model.name: model for model in MODELS.values()}


def find_model(folder: Path) -> tuple[Path, Path] | None:
    """The files of cameras and of images of a model in this folder, binary ones first; None if there is no model."""
    for suffix in (".bin", ".txt"):
        files = folder / f"cameras{suffix}", folder / f"images{suffix}"
        if all(file.is_file() for file in files):
            return files
    return None


def read_model(folder: Path) -> Poses:
    """The poses of a model's images with their cameras.

    Raises:
        InputError: for a folder without a model, and what is wrong in its files.
    """
    files = find_model(folder)
    if files is None:
        advice = "name the folder of one model, as sparse/0"
        raise InputError(folder, "cameras and images of a COLMAP model, .bin or .txt", "none", advice)
    lenses = read_cameras(files[0])
    images = list(_images_in_binary(files[1]) if files[1].suffix == ".bin" else _images_in_text(files[1]))
    if not images:
        raise InputError(files[1], "images with poses", "none", ADVICE)
    names, rows, cameras = (list(column) for column in zip(*images, strict=True))
    for name, camera in zip(names, cameras, strict=True):
        if camera not in lenses:
            raise InputError(files[1], f"a camera of {files[0].name} for image {name}", f"camera {camera}", ADVICE)
    table = np.array(rows)
    poses = from_quats(files[1], table[:, :4], table[:, 4:], [f"image {name}" for name in names])
    return Poses(poses, names=names, lenses=[lenses[camera] for camera in cameras])


def read_cameras(path: Path) -> dict[int, Lens]:
    """The cameras of a cameras.txt or cameras.bin, by id.

    Raises:
        InputError: for a camera with distortion, or a file that is not of this format.
    """
    cameras = list(_cameras_in_binary(path) if path.suffix == ".bin" else _cameras_in_text(path))
    if not cameras:
        raise InputError(path, "lines of cameras: CAMERA_ID MODEL WIDTH HEIGHT PARAMS", "none", ADVICE)
    return {camera: _lens(path, model, size, parameters) for camera, model, size, parameters in cameras}


def _lens(path: Path, model: CameraModel, size: tuple[int, int], parameters: np.ndarray) -> Lens:
    focals, rest = parameters[: model.focals], parameters[model.focals :]
    return pinhole(path, model.name, size, np.array([focals[0], focals[-1], *rest[:2]]), rest[2:], model.pinhole)


_Camera = tuple[int, CameraModel, tuple[int, int], np.ndarray]
_Image = tuple[str, list[float], int]
"""Name, qw qx qy qz tx ty tz, id of the camera."""


def _cameras_in_text(path: Path) -> Iterator[_Camera]:
    for n, line in _lines(path):
        words = line.split()
        if not words:
            continue
        expected = f"CAMERA_ID MODEL WIDTH HEIGHT PARAMS in line {n}"
        model = BY_NAME.get(words[1]) if len(words) > 1 else None
        if model is None:
            known = f"{expected}, the model one of {', '.join(BY_NAME)}"
            raise InputError(path, known, f"'{line[:40]}'", ADVICE)
        if len(words) != 4 + model.parameters:
            raise InputError(
                path, f"{model.parameters} parameters of {model.name} in line {n}", f"{len(words) - 4}", ADVICE
            )
        try:
            yield int(words[0]), model, (int(words[2]), int(words[3])), np.array(words[4:], float)
        except ValueError as error:
            raise InputError(path, expected, f"'{line[:40]}'", ADVICE) from error


def _images_in_text(path: Path) -> Iterator[_Image]:
    lines = _lines(path)
    for n, line in lines:
        words = line.split(maxsplit=9)
        if not words:
            continue
        try:
            image = words[9].strip(), [float(word) for word in words[1:8]], int(words[8])
        except (ValueError, IndexError) as error:
            expected = f"IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME in line {n}"
            raise InputError(path, expected, f"'{line[:40]}'", ADVICE) from error
        next(lines, None)  # its pixels, an empty line if there are none
        yield image


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """The lines of a text file with their numbers, without comments."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, "lines of text, as in COLMAP's text format", "no text", ADVICE) from error
    return ((n, line) for n, line in enumerate(lines, start=1) if not line.lstrip().startswith("#"))


class _Records:
    """Binary records, one after the other."""

    def __init__(self, path: Path) -> None:
        """Read from the first byte on."""
        self.path, self.content, self.at = path, path.read_bytes(), 0

    def take(self, size: int) -> bytes:
        """The next `size` bytes."""
        found = self.content[self.at : self.at + size]
        if len(found) < size:
            raise InputError(self.path, "a complete file of COLMAP's binary format", "one that ends too early", ADVICE)
        self.at += size
        return found

    def name(self) -> str:
        """Text up to the next zero."""
        end = self.content.find(b"\0", self.at)
        text = self.take(end - self.at if end >= 0 else len(self.content) + 1)
        self.at += 1
        return text.decode("utf-8", "replace")

    def count(self) -> int:
        """A number of records."""
        return int(COUNT.unpack(self.take(COUNT.size))[0])


def _cameras_in_binary(path: Path) -> Iterator[_Camera]:
    records = _Records(path)
    for _ in range(records.count()):
        camera, number, width, height = CAMERA.unpack(records.take(CAMERA.size))
        if number not in MODELS:
            raise InputError(path, "a camera model PINHOLE or SIMPLE_PINHOLE", f"model number {number}", ADVICE)
        model = MODELS[number]
        yield camera, model, (width, height), np.frombuffer(records.take(8 * model.parameters), "<f8")


def _images_in_binary(path: Path) -> Iterator[_Image]:
    records = _Records(path)
    for _ in range(records.count()):
        _, *pose, camera = IMAGE.unpack(records.take(IMAGE.size))
        name = records.name()
        records.take(records.count() * OBSERVATION.itemsize)
        yield name, pose, camera
