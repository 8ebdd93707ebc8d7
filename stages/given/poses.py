"""Camera poses that a user gives: which of them belong to which frame, and what poses must be."""

import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from stages.given.cameras import Lens
from stages.shared import lie
from stages.shared.errors import InputError
from stages.shared.sequences import Sequence

ORTHONORMAL = 1e-3
"""Largest difference of R R^T from the identity: files round to a few digits."""
UNIT_LENGTH = 1e-2
"""Largest difference of a quaternion's length from 1."""
NEAR = 0.25
"""A pose belongs to a frame if their time stamps differ by at most this share of the time between frames."""


@dataclass(frozen=True)
class Poses:
    """The n poses of a file.

    Attributes:
        cam_from_world: [n, 4, 4].
        names: [n] names of the images; None: they have time stamps instead.
        stamps: [n], ascending; None: they have names instead.
        lenses: [n] of the images; None: the file has none.
    """

    cam_from_world: np.ndarray
    names: list[str] | None = None
    stamps: np.ndarray | None = None
    lenses: list[Lens] | None = None


def rotations(source: Path, R: np.ndarray, labels: list[str]) -> np.ndarray:
    """The rotation matrices [n, 3, 3] without their rounding errors; `labels` [n] name them in messages.

    Raises:
        InputError: for a matrix that is not a rotation.
    """
    off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2))
    advice = "write the poses without scale, in right-handed axes"
    for wrong, what in (
        (~np.isfinite(R).all(axis=(1, 2)), "numbers that are not finite"),
        (~(off <= ORTHONORMAL), f"one whose rows are off by {np.nanmax(off, initial=0):.2g}"),
        (np.linalg.det(R) < 0, "a reflection: its axes are left-handed"),
    ):
        if wrong.any():
            raise InputError(source, f"a rotation matrix for {labels[int(np.argmax(wrong))]}", what, advice)
    return lie.matrix_from_quat(lie.quat_from_matrix(R))


def from_quats(source: Path, quats: np.ndarray, translations: np.ndarray, labels: list[str]) -> np.ndarray:
    """Rigid motions [n, 4, 4] from quaternions wxyz [n, 4] and translations [n, 3]; `labels` [n] name them.

    Raises:
        InputError: for numbers that are not finite, and quaternions whose length is not 1.
    """
    values = np.concatenate([quats, translations], axis=1)
    if not np.isfinite(values).all():
        wrong = labels[int(np.argmin(np.isfinite(values).all(axis=1)))]
        raise InputError(source, f"finite numbers for {wrong}", "NaN or infinity", "write the poses again")
    lengths = np.linalg.norm(quats, axis=1)
    off = np.abs(lengths - 1)
    if len(off) and off.max() > UNIT_LENGTH:
        k = int(off.argmax())
        advice = "check the order of the columns"
        raise InputError(source, f"a quaternion of length 1 for {labels[k]}", f"length {lengths[k]:.4g}", advice)
    return lie.from_parts(lie.matrix_from_quat(quats), translations)


def of_frames(source: Path, poses: Poses, frames: Sequence) -> list[int]:
    """The index of the pose of every frame.

    Poses with names are matched by the names of the frames' files, else by the numbers in them; those with time stamps
    by these, or by the frames' numbers where frames have none, and one after the other if there are as many as frames.

    Raises:
        InputError: names the first frame without a pose.
    """
    if poses.names is not None:
        found, keys = _by_name(poses.names, frames), f"{len(poses.names)} images, the first '{poses.names[0]}'"
    else:
        assert poses.stamps is not None, "poses have names or time stamps"
        found, low, high = _by_stamp(poses.stamps, frames), poses.stamps[0], poses.stamps[-1]
        keys = f"{len(poses.stamps)} time stamps {low:.6g} .. {high:.6g} for {_stamps_in_words(frames)}"
    lacking = [path.name for path, k in zip(frames.frames, found, strict=True) if k is None]
    if lacking:
        expected = f"a pose for each of the {len(found)} frames"
        told = f"none for {len(lacking)} of them, the first {lacking[0]}, among {keys}"
        raise InputError(source, expected, told, "give the poses of all frames, or use fewer frames")
    return [k for k in found if k is not None]


def _by_name(names: list[str], frames: Sequence) -> list[int | None]:
    files = [PurePosixPath(name.replace("\\", "/")) for name in names]
    by_name, by_stem = ({getattr(file, key): k for k, file in enumerate(files)} for key in ("name", "stem"))
    for found in (
        [by_name.get(path.name) for path in frames.frames],
        [by_stem.get(path.stem) for path in frames.frames],
    ):
        if any(k is not None for k in found):
            return found
    numbers = {int(digits[-1]): k for k, file in enumerate(files) if (digits := re.findall(r"\d+", file.stem))}
    return [numbers.get(number) for number in frames.numbers]


def _by_stamp(stamps: np.ndarray, frames: Sequence) -> list[int | None]:
    wanted = np.asarray(frames.stamps, float)
    nearest = np.abs(stamps[None] - wanted[:, None]).argmin(axis=1)
    near = np.abs(stamps[nearest] - wanted) <= NEAR * float(np.median(np.diff(wanted)))
    if not near.all() and len(stamps) == len(wanted):
        return list(range(len(wanted)))
    return [int(k) if fits else None for k, fits in zip(nearest, near, strict=True)]


def _stamps_in_words(frames: Sequence) -> str:
    kind = "frame numbers" if frames.times_s is None else "times of frames, s,"
    return f"{kind} {frames.stamps[0]:.6g} .. {frames.stamps[-1]:.6g}"
