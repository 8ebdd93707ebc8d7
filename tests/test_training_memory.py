"""Training keeps frames as far as its memory goes, and flow is given back while it is read."""

from pathlib import Path

import gaussian_scene as truth
import numpy as np
import pytest
from gaussian_files import write_inputs

from stages.gaussians import inputs, optimise
from stages.gaussians.beginning import begin
from stages.gaussians.options import GaussiansOptions
from stages.shared import flow_pairs
from stages.shared.artifacts import Dense
from stages.shared.flow_pairs import FlowPairs
from stages.shared.images import read_rgb
from stages.shared.memory import Held, megabytes

PIXELS = truth.WIDTH * truth.HEIGHT
KEPT = 2


def test_frames_beyond_the_memory_are_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two pictures and two targets of nine have room."""
    read: list[Path] = []
    monkeypatch.setattr(inputs, "read_rgb", lambda path: read.append(path) or read_rgb(path))
    monkeypatch.setattr(inputs, "PICTURE_BYTES", KEPT * 3 * PIXELS + 1)
    monkeypatch.setattr(optimise, "TARGET_BYTES", KEPT * optimise.TARGET_PIXEL_BYTES * PIXELS + 1)
    start = begin(*write_inputs(tmp_path).values(), GaussiansOptions(steps=1), tmp_path)
    F = len(start.seen.images)
    read.clear()
    first = [start.trainer.targets[f] for f in range(F)]
    assert len(read) == F - KEPT
    again = [start.trainer.targets[f] for f in range(F)]
    assert [new is old for new, old in zip(again, first, strict=True)] == [True] * KEPT + [False] * (F - KEPT)


def test_what_a_job_asks_for_holds_what_training_keeps_of_a_long_clip_within_eight_gigabytes() -> None:
    frame = 1920 * 1080
    asked = megabytes("gaussians", Held(10**8, 300 * frame, frame, 300 * 512 * 288, 10**8))
    assert inputs.PICTURE_BYTES + optimise.TARGET_BYTES < asked * 1e6 < 8e9


def test_flow_is_given_back_after_every_block_of_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 40 frames with one edge each, no more than a block is held, whichever way they are gone through."""
    T = 40
    ends = {"source": np.arange(T - 1), "target": np.arange(1, T)}
    images = {"flow": np.zeros((T - 1, 4, 6, 2), np.float16), "confidence": np.ones((T - 1, 4, 6), np.float16)}
    held, most = [0], []
    monkeypatch.setattr(Dense, "release", lambda _: most.append(held[0]) or held.__setitem__(0, 0))
    pairs = FlowPairs(Dense({**ends, **images}))

    def reads(_edge: int) -> None:
        held[0] += 1

    pairs.threaded(reads, range(T - 1))
    assert (sum(most), max(most)) == (T - 1, flow_pairs.BLOCK)
    most.clear()
    for first, end in pairs.blocks(T, "flow"):
        for edge in pairs.leaving(first, end):
            reads(edge)
    assert (sum(most), max(most)) == (T - 1, flow_pairs.BLOCK)
