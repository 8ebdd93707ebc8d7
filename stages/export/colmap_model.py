"""COLMAP's sparse model, in text and in binary (https://colmap.github.io/format.html), as PINHOLE cameras.

Pixels are COLMAP's: the centre of the first one is (0.5, 0.5). Identifiers begin at 1. The files of rigs and frames,
which COLMAP writes since version 3.12, are left out: readers make them from the images.
"""

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.export.points import Points
from stages.shared import lie
from stages.shared.colmap_records import CAMERA, COUNT, IMAGE, OBSERVATION, PINHOLE
from stages.shared.conventions import CENTRE_PX, half_integer_centres

NO_POINTS = Points(
    *(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0)),
    *(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2))),
)


@dataclass(frozen=True)
class Model:
    """Images with cameras and points.

    Attributes:
        names: file names of the T images. width, height: px.
        cam_from_world: [T, 4, 4]. Ks: [T, 3, 3] px, pixel centres at integers. points: with frames 0..T-1.
    """

    names: list[str]
    width: int
    height: int
    cam_from_world: np.ndarray
    Ks: np.ndarray
    points: Points

    def cameras(self) -> tuple[np.ndarray, np.ndarray]:
        """Parameters fx fy cx cy [C, 4] of the distinct cameras in COLMAP's pixels, and the index [T] of each image."""
        Ks = half_integer_centres(self.Ks)
        parameters = np.stack([Ks[:, 0, 0], Ks[:, 1, 1], Ks[:, 0, 2], Ks[:, 1, 2]], axis=-1)
        distinct, index = np.unique(parameters, axis=0, return_inverse=True)
        return distinct, index.reshape(-1)

    def images(self) -> Iterator[tuple[int, np.ndarray, int, str, np.ndarray, np.ndarray]]:
        """Of every image: id, qw qx qy qz tx ty tz [7], camera id, name, pixels [n, 2] and ids of their points [n]."""
        quats = lie.quat_from_matrix(self.cam_from_world[:, :3, :3])
        _, camera = self.cameras()
        bounds = np.searchsorted(self.points.frame, np.arange(len(self.names) + 1))
        for k, name in enumerate(self.names):
            pose = np.concatenate([quats[k], self.cam_from_world[k, :3, 3]])
            part = slice(bounds[k], bounds[k + 1])
            yield k + 1, pose, int(camera[k]) + 1, name, self.points.uv[part] + CENTRE_PX, self.points.point[part] + 1

    def tracks(self) -> list[np.ndarray]:
        """Of every point, its image ids and the indices of its pixels there, [n, 2] int32."""
        frame, point = self.points.frame, self.points.point
        first = np.searchsorted(frame, np.arange(len(self.names)))
        pairs = np.stack([frame + 1, np.arange(len(frame)) - first[frame]], axis=-1).astype(np.int32)
        order = np.argsort(point, kind="stable")
        ends = np.cumsum(np.bincount(point, minlength=len(self.points.xyz)))
        return np.split(pairs[order], ends[:-1]) if len(ends) else []


def write_text(folder: Path, model: Model) -> None:
    """Write cameras.txt, images.txt and points3D.txt into an existing folder."""
    parameters, _ = model.cameras()
    lines = ["# CAMERA_ID MODEL WIDTH HEIGHT fx fy cx cy"]
    lines += [f"{c + 1} PINHOLE {model.width} {model.height} {_words(row)}" for c, row in enumerate(parameters)]
    _write_lines(folder / "cameras.txt", lines)
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then its X Y POINT3D_ID ..."]
    for image, pose, camera, name, uv, ids in model.images():
        pixels = (f"{_words(pixel)} {point}" for pixel, point in zip(uv, ids, strict=True))
        lines += [f"{image} {_words(pose)} {camera} {name}", " ".join(pixels)]
    _write_lines(folder / "images.txt", lines)
    lines, points = ["# POINT3D_ID X Y Z R G B ERROR, then its IMAGE_ID POINT2D_IDX ..."], model.points
    for n, (xyz, rgb, error, track) in enumerate(
        zip(points.xyz, points.rgb, points.error_px, model.tracks(), strict=True)
    ):
        lines.append(f"{n + 1} {_words(xyz)} {_words(rgb)} {error:.17g} {_words(track.ravel())}")
    _write_lines(folder / "points3D.txt", lines)


def write_distorted(
    folder: Path,
    names: list[str],
    size: tuple[int, int],
    cam_from_world: np.ndarray,
    Ks: np.ndarray,
    coefficients_px: Sequence[float],
) -> None:
    """Write images before they were undistorted as RADIAL cameras, in text, without points, into an existing folder.

    Args:
        names: file names of the T images. size: width and height in px.
        cam_from_world: [T, 4, 4]. Ks: [T, 3, 3] px, pixel centres at integers.
        coefficients_px: k1 / f^2 and k2 / f^4 of the focal length f in px.
    """
    model = Model(names, *size, cam_from_world, Ks, NO_POINTS)
    parameters, _ = model.cameras()
    lines = ["# CAMERA_ID MODEL WIDTH HEIGHT f cx cy k1 k2"]
    for c, (f, _, cx, cy) in enumerate(parameters):
        k = np.array(coefficients_px) * f ** np.array([2, 4])
        lines.append(f"{c + 1} RADIAL {size[0]} {size[1]} {_words(np.array([f, cx, cy, *k]))}")
    _write_lines(folder / "cameras.txt", lines)
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then an empty line: no points"]
    lines += [f"{image} {_words(pose)} {camera} {name}\n" for image, pose, camera, name, _, _ in model.images()]
    _write_lines(folder / "images.txt", lines)
    _write_lines(folder / "points3D.txt", ["# no points: those of sparse_text/ are seen in the undistorted images"])


def write_binary(folder: Path, model: Model) -> None:
    """Write cameras.bin, images.bin and points3D.bin into an existing folder."""
    parameters, _ = model.cameras()
    parts = [COUNT.pack(len(parameters))]
    size = (model.width, model.height)
    for c, row in enumerate(parameters):
        parts += [CAMERA.pack(c + 1, PINHOLE, *size), row.astype("<f8").tobytes()]
    (folder / "cameras.bin").write_bytes(b"".join(parts))
    parts = [COUNT.pack(len(model.names))]
    for image, pose, camera, name, uv, ids in model.images():
        pixels = np.empty(len(uv), OBSERVATION)
        pixels["uv"], pixels["point"] = uv, ids
        parts += [IMAGE.pack(image, *pose, camera), name.encode() + b"\0", COUNT.pack(len(uv)), pixels.tobytes()]
    (folder / "images.bin").write_bytes(b"".join(parts))
    points = model.points
    parts = [COUNT.pack(len(points.xyz))]
    for n, (xyz, rgb, error, track) in enumerate(
        zip(points.xyz, points.rgb, points.error_px, model.tracks(), strict=True)
    ):
        parts += [struct.pack("<Q3d3BdQ", n + 1, *xyz, *rgb, error, len(track)), track.astype("<i4").tobytes()]
    (folder / "points3D.bin").write_bytes(b"".join(parts))


def _words(values: np.ndarray) -> str:
    """Numbers as text that reads back as the same numbers."""
    return " ".join(f"{value:.17g}" for value in values.tolist())


def _write_lines(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
