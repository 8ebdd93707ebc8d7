"""MPI-Sintel files: .flo, .dpt and .cam, little-endian, each beginning with the float32 tag 202021.25."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from stages.shared import lie
from stages.shared.atomic import atomic
from stages.shared.errors import InputError

TAG = np.float32(202021.25)
CAM_BYTES = 4 + 9 * 8 + 12 * 8
ADVICE = "check that the file is complete and of this format"
SAME_CAMERA = 1e-3
"""Intrinsics count as equal if they differ by less than this share of the focal length. Such a difference of the focal
length moves pixels at the border of a frame 512 px wide by a quarter of a pixel."""


def read_flo(path: Path) -> np.ndarray:
    """Optical flow [H, W, 2] float32, (u, v) in pixels."""
    return _read_dense(path, channels=2)


def write_flo(path: Path, flow: np.ndarray) -> None:
    """Write optical flow [H, W, 2] in pixels."""
    _write_dense(path, flow)


def read_dpt(path: Path) -> np.ndarray:
    """z-depth [H, W] float32 in scene units."""
    return _read_dense(path, channels=1)[..., 0]


def write_dpt(path: Path, depth: np.ndarray) -> None:
    """Write z-depth [H, W] in scene units."""
    _write_dense(path, depth)


def read_cam(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics K [3, 3] and cam_from_world [3, 4], both float64."""
    content = _read_tagged(path)
    if len(content) != CAM_BYTES:
        raise InputError(path, f"{CAM_BYTES} bytes", f"{len(content)}", ADVICE)
    values = np.frombuffer(content, "<f8", offset=4)
    return values[:9].reshape(3, 3).copy(), values[9:].reshape(3, 4).copy()


def read_cams(paths: Iterable[Path]) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics [n, 3, 3] and cam_from_world [n, 4, 4] of n files, both float64."""
    Ks, extrinsics = (np.stack(parts) for parts in zip(*map(read_cam, paths), strict=True))
    return Ks, lie.from_parts(extrinsics[..., :3], extrinsics[..., 3])


def read_shared_intrinsics(paths: Sequence[Path]) -> np.ndarray:
    """The K [3, 3] that n files share, without skew.

    Raises:
        InputError: names the first file whose intrinsics differ or have a skew.
    """
    Ks = read_cams(paths)[0]
    fx, fy, cx, cy = Ks[0, 0, 0], Ks[0, 1, 1], *Ks[0, :2, 2]
    shared = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    for path, K in zip(paths, Ks, strict=True):
        if not np.abs(K - shared).max() < SAME_CAMERA * fx:
            expected = f"fx {fx:.6g}, fy {fy:.6g} px, centre ({cx:.6g}, {cy:.6g}), no skew, as one shared camera"
            found = f"fx {K[0, 0]:.6g}, fy {K[1, 1]:.6g}, centre ({K[0, 2]:.6g}, {K[1, 2]:.6g}), skew {K[0, 1]:.6g}"
            advice = "it cannot be taken as truth: set `intrinsics: estimate` and `ba: {poses_from: estimate}`"
            raise InputError(path, expected, found, advice)
    return shared


def write_cam(path: Path, K: np.ndarray, cam_from_world: np.ndarray) -> None:
    """Write intrinsics [3, 3] and cam_from_world [3, 4]."""
    values = np.concatenate([np.ravel(K), np.ravel(cam_from_world)]).astype("<f8")
    with atomic(path) as partial:
        partial.write_bytes(TAG.astype("<f4").tobytes() + values.tobytes())


def _read_tagged(path: Path) -> bytes:
    content = path.read_bytes()
    if len(content) < 4:
        raise InputError(path, f"the float32 tag {TAG} first", f"a file of {len(content)} bytes", ADVICE)
    tag = np.frombuffer(content, "<f4", count=1)[0]
    if tag != TAG:
        raise InputError(path, f"the float32 tag {TAG} first", f"{tag:g}", ADVICE)
    return content


def _read_dense(path: Path, channels: int) -> np.ndarray:
    content = _read_tagged(path)
    width, height = np.frombuffer(content.ljust(12, b"\0"), "<i4", count=2, offset=4).tolist()
    if not (0 < width < 100_000 and 0 < height < 100_000):
        raise InputError(path, "a width and height in 1..99999", f"{width} x {height}", ADVICE)
    size = 12 + 4 * width * height * channels
    if len(content) != size:
        raise InputError(path, f"{size} bytes for {width} x {height}", f"{len(content)}", ADVICE)
    return np.frombuffer(content, "<f4", offset=12).reshape(height, width, channels).copy()


def _write_dense(path: Path, values: np.ndarray) -> None:
    height, width = values.shape[:2]
    header = TAG.astype("<f4").tobytes() + np.array([width, height], "<i4").tobytes()
    with atomic(path) as partial:
        partial.write_bytes(header + np.ascontiguousarray(values, "<f4").tobytes())
