"""Rounds that find what the round before found: where the static area has not changed, neither has the solution."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from stages.ba.graph import static_areas
from stages.shared.artifacts import read_metadata, read_table, write_table
from stages.shared.atomic import copy
from stages.shared.cameras import read_cameras, write_tum
from stages.shared.errors import InputError
from stages.shared.log import logger
from stages.shared.masks import read_mask
from stages.shared.run_inputs import mask_source
from stages.shared.sequences import Sequence

SHRANK, NOT_CONVERGED = "static area shrank", "rounds have not converged"
"""Warnings of a round that compares itself with the one before."""
SAME_SHARE, SAME_SHARE_OF_A_FRAME = 0.005, 0.05
"""Static areas that differ in a smaller share of the pixels, of the clip and of every frame, count as the same."""


class Results(NamedTuple):
    """Files of a round besides its trajectory."""

    poses: Path
    depth: Path
    convergence: Path
    figure: Path


def read_static_areas(masks: Path | None, frames: Sequence, size: tuple[int, int]) -> np.ndarray:
    """Static area [T, height, width] on a flow grid of this `size` that masks leave; without any, everything."""
    if masks is None:
        return np.ones((len(frames.numbers), *size[::-1]), np.int8)
    return static_areas((read_mask(masks, frames, k) for k in range(len(frames.numbers))), *size)


def tell_movers(masks: Path | None) -> bool:
    """Whether masks say what moves, also where they say that nothing does; with `segment.source: none` they do not."""
    return masks is not None and not ((masks / "masks.json").exists() and mask_source(masks) == "none")


def complete(*files: Path | None) -> Results:
    """The results of the round before, which are given with its masks.

    Raises:
        InputError: if one of them is missing.
    """
    found = [file for file in files if file is not None]
    if len(found) < len(files):
        every = "--previous-poses, -depth, -convergence and -figure"
        raise InputError("--previous-masks", f"together with {every}", "only some of them", "give all or none")
    return Results(*found)


def has_converged(before: Results) -> bool:
    """Whether another adjustment with the same masks would find what the round before found.

    That round began from the poses of an earlier one, as this one would: the first begins from guesses, and the next
    gains on it with the same masks (a fast chase: path error .033 % to .020 %). And it has no warning that rounds have
    not converged.
    """
    about = read_metadata(before.poses)
    converged = not any(NOT_CONVERGED in flag for flag in about.get("flags", []))
    return bool(about.get("from_previous_round")) and converged


def is_same(static: np.ndarray, before: np.ndarray) -> bool:
    """Whether the static areas [T, h, w] (1 static, 0 dynamic) of two rounds are the same but for a few pixels."""
    changed = np.abs(static - before).mean(axis=(1, 2))
    return bool(changed.mean() < SAME_SHARE and changed.max() < SAME_SHARE_OF_A_FRAME)


def carry_over(frames: Sequence, before: Results, after: Results, trajectory: Path) -> str:
    """Write the results of the round before again, with their trajectory; the result in words.

    The warning that the static area shrank is left out: it has not shrunk since.
    """
    about = read_metadata(before.poses)
    flags = [flag for flag in about["flags"] if not flag.startswith(SHRANK)]
    write_table(after.poses, read_table(before.poses), about | {"flags": flags})
    write_tum(trajectory, read_cameras(after.poses), frames.stamps)
    for source, target in zip(before[1:], after[1:], strict=True):
        copy(source, target)
    logger.info("%s: the static area is that of the round before, and so are the poses", frames.name)
    return "static area unchanged: the poses of the round before"
