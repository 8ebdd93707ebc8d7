"""Paths of more than a hundred frames: the work of the adjustment is linear in the frames, and finds the same path."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.bench_ba_growth import FOCAL_PX, clip, path_error, walk
from stages.ba import estimate as estimation
from stages.ba import proposal, shutter
from stages.ba.graph import FlowGraph
from stages.ba.options import BAOptions
from stages.ba.part import FRAMES
from stages.ba.problem import Problem
from stages.ba.state import FocalPrior, State, Unknowns
from stages.shared import lie

T, STRIDE = 150, 44
LOOP = 110
"""Frames between the ends of an edge that joins places."""


def joined(graph: FlowGraph) -> FlowGraph:
    """The graph with edges that claim to see a place again, but have no weight."""
    ends = np.arange(T - LOOP)
    source, target = np.append(ends, ends + LOOP), np.append(ends + LOOP, ends)
    source, target = np.append(graph.source, source), np.append(graph.target, target)
    order = np.lexsort((target, source))
    empty = np.zeros((len(source) - len(graph.source), len(graph.pixels), 3), np.float32)
    matches, weights = np.append(graph.matches, empty[..., :2], 0), np.append(graph.weights, empty[..., 2], 0)
    arrays = {"source": source[order], "target": target[order], "matches": matches[order], "weights": weights[order]}
    return replace(graph, pointer=np.searchsorted(source[order], np.arange(T + 1)), **arrays)


def test_a_long_path_takes_few_passes_and_its_loops_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """From a focal length of 1.2 times the true one. There were 89 passes, with loops in each; now 54."""
    graph, truth = clip(T, STRIDE)
    graph, visited, before_loops = joined(graph), [], []
    add, find = proposal.normal_equations, estimation.find_start

    def adding(data: Any, *args: Any, **kwargs: Any) -> Any:
        visited.append((len(data.source), int(np.abs(data.target - data.source).max())))
        return add(data, *args, **kwargs)

    def finding(observed: Any) -> Any:
        found = find(observed)
        before_loops.extend(visited)
        return found

    monkeypatch.setattr(proposal, "normal_equations", adding)
    monkeypatch.setattr(estimation, "find_start", finding)
    options = BAOptions.model_validate({"start_focals": (1.2,), "rolling_shutter": "no"})
    found = estimation.estimate(Problem(graph, masked=False), options)
    assert path_error(found.state.cam_from_world, truth) < 2e-4
    assert found.state.focal_px == pytest.approx(FOCAL_PX, rel=2e-3)
    assert sum(edges for edges, _ in visited) < 70 * len(graph.source)
    assert max(reach for _, reach in before_loops) < LOOP
    assert found.zoom.decision == "constant"


def test_a_shutter_is_told_from_the_hundred_frames_that_shake_most(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, _ = clip(T, 2 * STRIDE)
    poses, seen = walk(T), []
    poses[-4::2] = lie.exp_se3(np.array([0, 0, 0, 0.02, 0, 0])) @ poses[-4::2]
    state = State(poses, np.ones((T, len(graph.pixels))), FOCAL_PX)

    class Seen(Exception):
        pass

    def fitting(parts: Any, state: State, *_: Any) -> None:
        seen.append((parts[0].T, state.cam_from_world))
        raise Seen

    monkeypatch.setattr(shutter.held_out, "fit", fitting)
    with pytest.raises(Seen):
        shutter.weigh(graph, state, Unknowns(focal=True), FocalPrior(FOCAL_PX), assumed=False)
    frames, path = seen[0]
    assert frames == FRAMES
    (first,) = np.flatnonzero((poses == path[0]).all(axis=(1, 2)))
    np.testing.assert_array_equal(path, poses[first : first + FRAMES])
    assert first + FRAMES >= T - 1
