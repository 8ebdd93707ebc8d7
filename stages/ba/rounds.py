"""Rounds that find what the round before found: where the static area has not changed, neither has the solution."""

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stages.ba.diagnostics import NOT_CONVERGED, SHRANK
from stages.shared.artifacts import atomic, read_metadata, read_table, write_table
from stages.shared.cameras import read_cameras, write_tum
from stages.shared.errors import InputError
from stages.shared.log import logger

SAME_SHARE, SAME_SHARE_OF_A_FRAME = 0.005, 0.05
"""Static areas that differ in a smaller share of the pixels, of the clip and of every frame, count as the same."""


def is_settled(poses: Path | None, static: np.ndarray, before: np.ndarray) -> bool:
    """Whether another adjustment would find what the round before found.

    That round began from poses of an earlier one, as this one would: the first begins from guesses, and the next gains
    on it with the same masks (a fast chase: path error .033 % to .020 %). It has no
    warning that rounds have not converged. The static areas [T, h, w] (1 static, 0 dynamic) of the two are the same.

    Args:
        poses: poses.parquet of the round before.
    """
    about = read_metadata(poses) if poses is not None else {}
    if not about.get("from_previous_round") or any(NOT_CONVERGED in flag for flag in about["flags"]):
        return False
    changed = np.abs(static - before).mean(axis=(1, 2))
    return bool(changed.mean() < SAME_SHARE and changed.max() < SAME_SHARE_OF_A_FRAME)


def carry_over(name: str, before: Sequence[Path | None], files: Sequence[Path], trajectory: Path) -> str:
    """Write the results of the round before again, poses.parquet first, and their trajectory; the result in words.

    The warning that the static area shrank is left out: it has not shrunk since.

    Raises:
        InputError: if one of the results before is missing.
    """
    for source, target in zip(before, files, strict=True):
        if source is None:
            every = "--previous-poses, -depth, -convergence and -figure"
            raise InputError("--previous-masks", f"together with {every}", "only some of them", "give all or none")
        with atomic(target) as file:
            shutil.copyfile(source, file)
    about = read_metadata(files[0])
    flags = [flag for flag in about["flags"] if not flag.startswith(SHRANK)]
    write_table(files[0], read_table(files[0]), about | {"flags": flags})
    write_tum(trajectory, read_cameras(files[0]))
    logger.info("%s: the static area is that of the round before, and so are the poses", name)
    return "static area unchanged: the poses of the round before"
