"""Examples to learn from: what is known near the borders of masks, and what moves there by the truth."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stages.evaluate.ground_truth import true_masks, true_movers
from stages.segment.boundaries import bounded, maps_of, near_border
from stages.segment.options import SegmentOptions
from stages.segment.permanence import DYNAMIC
from stages.segment.refined import evidence_of_clip
from stages.shared.atomic import atomic
from stages.shared.images import REFERENCE_PX, read_rgb
from stages.shared.sequences import read_sequence
from stages.shared.settled import Solved

EVERY = 3
"""Frames, of which one teaches: those between look alike."""
OPEN = 2
"""Stands for pixels whose truth is open: of things that move in the clip, and rest in this frame."""


class Example(NamedTuple):
    """A frame.

    Attributes:
        maps: [n, H, W] float16 of `maps_of`. truth: [H, W] uint8, 1 where something moves, or OPEN.
        asked: [H, W] bool of `near_border`.
    """

    maps: np.ndarray
    truth: np.ndarray
    asked: np.ndarray


def of_sequence(results: Path, kept: Path) -> list[Example]:
    """The examples of a sequence with truth, from its folder of results; kept in a file, and read from there again.

    None of one that has not been solved yet, or whose frames are larger than those that the network sees.
    """
    path = kept / f"{results.name}.npz"
    if not path.exists():
        columns = [np.stack(of) for of in zip(*_found(results), strict=True)]
        if not columns:
            return []
        with atomic(path) as partial, partial.open("wb") as file:
            np.savez(file, maps=columns[0], truth=columns[1], asked=columns[2])
    with np.load(path) as held:
        return [Example(*of) for of in zip(held["maps"], held["truth"], held["asked"], strict=True)]


def _found(results: Path) -> Iterator[Example]:
    """The examples of the first and of the last round that begins with cameras: of poor ones, and of better ones."""
    frames = read_sequence(results / "lens/sequence.json")
    truth, movers = true_masks(frames)[0], true_movers(frames)
    if len(truth) < len(frames.numbers) or max(frames.width, frames.height) > REFERENCE_PX:
        return
    rounds = len(list(results.glob("round*"))) + 1
    for before in sorted({1, rounds - 1}):
        own = results if before + 1 == rounds else results / f"round{before + 1}"
        cameras = results / f"round{before}/ba"
        inputs = results / "lens/pairs.arrow", own / "motion/prior.arrow"
        if not all(path.exists() for path in (*inputs, cameras / "poses.parquet", cameras / "depth.arrow")):
            continue
        previous = Solved(cameras / "poses.parquet", cameras / "depth.arrow")
        found = evidence_of_clip(SegmentOptions(), frames, *inputs, previous, None)
        of_clip = bounded(len(frames.frames), lambda k: read_rgb(frames.frames[k]), found.known, SegmentOptions())
        for k, frame in enumerate(of_clip):
            asked = near_border(frame)
            if k % EVERY or frame.known.evidence is None or frame.threshold > DYNAMIC or not asked.any():
                continue
            moves = truth[frames.numbers[k]]
            rests = movers[frames.numbers[k]] & ~moves if movers else np.zeros_like(moves)
            told = np.where(rests, OPEN, moves).astype(np.uint8)
            yield Example(maps_of(frame).astype(np.float16), told, asked)
