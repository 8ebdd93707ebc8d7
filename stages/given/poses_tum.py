"""Trajectories in TUM's format (https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats), world-from-camera."""

from pathlib import Path

import numpy as np

from stages.given.poses import Poses, from_quats
from stages.shared import lie
from stages.shared.errors import InputError

COLUMNS = "timestamp tx ty tz qx qy qz qw"


def read_tum(path: Path) -> Poses:
    """The poses of a TUM file, in the order of their time stamps.

    Raises:
        InputError: names the first line that is wrong.
    """
    rows, labels, advice = [], [], "write it in TUM's format, or name a COLMAP folder or a transforms.json"
    for n, line in enumerate(_lines(path, advice), start=1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            rows.append([float(word) for word in words])
        except ValueError as error:
            raise InputError(path, f"numbers in line {n}: {COLUMNS}", f"'{line.strip()[:40]}'", advice) from error
        if len(rows[-1]) != 8:
            raise InputError(path, f"8 numbers in line {n}: {COLUMNS}", f"{len(rows[-1])}", advice)
        if not np.isfinite(rows[-1][0]):
            raise InputError(path, f"a finite time stamp in line {n}", f"{rows[-1][0]}", advice)
        labels.append(f"line {n}")
    if not rows:
        raise InputError(path, f"lines of poses: {COLUMNS}", "none", advice)
    table = np.array(rows)
    order = np.argsort(table[:, 0], kind="stable")
    table, labels = table[order], [labels[k] for k in order]
    if not (np.diff(table[:, 0]) > 0).all():
        k = int(np.argmin(np.diff(table[:, 0]) > 0))
        raise InputError(
            path, "time stamps that differ", f"{table[k, 0]:.17g} in {labels[k]} and {labels[k + 1]}", advice
        )
    world_from_cam = from_quats(path, table[:, [7, 4, 5, 6]], table[:, 1:4], labels)
    return Poses(lie.inverse(world_from_cam), stamps=table[:, 0])


def _lines(path: Path, advice: str) -> list[str]:
    try:
        return path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, f"lines of text: {COLUMNS}", "no text", advice) from error
