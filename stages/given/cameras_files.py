"""Poses and intrinsics of the frames from the files that the options name."""

from pathlib import Path

import numpy as np

from stages.given import cameras, poses
from stages.given.cameras_colmap import find_model, read_cameras, read_model
from stages.given.cameras_transforms import read_transforms
from stages.given.files import of_sequence
from stages.given.intrinsics import parse
from stages.given.intrinsics_exif import focal_of_frames
from stages.given.poses_tum import read_tum
from stages.shared.cameras import centred_intrinsics
from stages.shared.errors import InputError
from stages.shared.sequences import Sequence


def read_intrinsics(text: str, frames: Sequence) -> np.ndarray:
    """K [3, 3] of the frames, in their pixels, by a value of `intrinsics:` other than estimate and truth.

    Raises:
        InputError: for a file that cannot be read, and numbers that cannot be right for these frames.
    """
    option = parse(text)
    source: Path | str = f"intrinsics: {text}"
    if option.kind == "file":
        source = of_sequence(option.path, frames.name)
        K = _shared(source, frames)
    elif option.kind == "exif":
        K = centred_intrinsics(focal_of_frames(frames), frames.width, frames.height)
    else:
        K = cameras.of_option(option, frames)
    cameras.check_range(source, K, frames)
    return K


def read_poses(text: str, frames: Sequence, lenses: bool = True) -> tuple[np.ndarray, np.ndarray | None]:
    """cam_from_world [T, 4, 4] and Ks [T, 3, 3] px of the frames from what `ba: {poses_from: ...}` names.

    The Ks are None for TUM's format, which has none, and a transforms.json without, and without `lenses`.

    Raises:
        InputError: for a file that cannot be read, frames without a pose, and cameras that cannot be right.
    """
    path = of_sequence(text, frames.name)
    require(path)
    read = read_model if path.is_dir() else read_transforms if path.suffix == ".json" else read_tum
    found = read(path)
    index = poses.of_frames(path, found, frames)
    if found.lenses is None or not lenses:
        return found.cam_from_world[index], None
    Ks = np.stack([cameras.in_frames(path, found.lenses[k], frames) for k in index])
    cameras.check_range(path, Ks, frames)
    cameras.check_one_lens(path, Ks)
    return found.cam_from_world[index], Ks


def require_lens(source: str, Ks: np.ndarray | None) -> None:
    """Refuse poses of `source` that are held fixed without intrinsics Ks [T, 3, 3].

    Raises:
        InputError: if there are none.
    """
    if Ks is None:
        advice = "set `intrinsics:`, or `ba: {poses_as: start}` to estimate the focal length"
        raise InputError(source, "intrinsics for poses that are held fixed", "none in this file", advice)


def find_cameras(path: Path) -> list[Path]:
    """The files that are read of a given path: those of a COLMAP model, else itself.

    Raises:
        InputError: if it does not exist.
    """
    require(path)
    return list(find_model(path) or []) if path.is_dir() else [path]


def require(path: Path) -> None:
    """Refuse a path that does not exist.

    Raises:
        InputError: in one line.
    """
    if not path.exists():
        raise InputError(path, "an existing file or folder", "nothing there", "correct the path in your config file")


def _shared(path: Path, frames: Sequence) -> np.ndarray:
    """K [3, 3] of the one camera of a cameras file."""
    require(path)
    lenses = list(read_cameras(path).values())
    Ks = np.stack([cameras.in_frames(path, lens, frames) for lens in lenses])
    if not np.allclose(Ks, Ks[0], rtol=cameras.SAME_LENS, atol=0):
        advice = "name the whole model in `ba: {poses_from: ...}`, whose images say which camera is theirs"
        raise InputError(path, "one camera for all frames", f"{len(Ks)} that differ", advice)
    return np.asarray(Ks[0])
