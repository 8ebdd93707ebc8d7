"""Rounds that find what the round before found: where the static area has not changed, neither has the solution."""

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stages.shared.artifacts import atomic
from stages.shared.cameras import read_cameras, write_tum
from stages.shared.errors import InputError
from stages.shared.log import logger

SAME_SHARE = 0.005
"""Static areas that differ in a smaller share of the pixels count as the same."""


def is_same(static: np.ndarray, before: np.ndarray) -> bool:
    """Whether the static areas [T, h, w] (1 static, 0 dynamic) of two rounds differ in less than SAME_SHARE."""
    return float(np.abs(static - before).mean()) < SAME_SHARE


def carry_over(name: str, before: Sequence[Path | None], files: Sequence[Path], trajectory: Path) -> str:
    """Copy the results of the round before, poses.parquet first, and write their trajectory; the result in words.

    Raises:
        InputError: if one of the results before is missing.
    """
    for source, target in zip(before, files, strict=True):
        if source is None:
            every = "--previous-poses, -depth, -convergence and -figure"
            raise InputError("--previous-masks", f"together with {every}", "only some of them", "give all or none")
        with atomic(target) as file:
            shutil.copyfile(source, file)
    write_tum(trajectory, read_cameras(files[0]))
    logger.info("%s: the static area is that of the round before, and so are the poses", name)
    return "static area unchanged: the poses of the round before"
