"""Paths of more than a hundred frames: the work of the adjustment is linear in the frames, and finds the same path."""

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.bench_ba_growth import FOCAL_PX, clip, path_error, walk
from stages.ba import classify, first_focal, proposal, shutter, zoom
from stages.ba import path as path_estimate
from stages.ba.estimate import estimate
from stages.ba.graph import FlowGraph
from stages.ba.guesses import Observed
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


def test_a_long_path_takes_few_passes_and_its_loops_wait(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """From a focal length of 1.2 times the true one. There were 89 passes, with loops in each; now 54.

    Paths of a part of it at other focal lengths take the edges of 16 more, rotations on a thinner grid those of 17.
    """
    graph, truth = clip(T, STRIDE)
    graph, visited, before_loops = joined(graph), [], []
    add, find = proposal.normal_equations, path_estimate.find_start

    def adding(data: Any, *args: Any, **kwargs: Any) -> Any:
        visited.append((len(data.source), int(np.abs(data.target - data.source).max())))
        return add(data, *args, **kwargs)

    def finding(observed: Any) -> Any:
        found = find(observed)
        before_loops.extend(visited)
        return found

    monkeypatch.setattr(proposal, "normal_equations", adding)
    monkeypatch.setattr(path_estimate, "find_start", finding)
    options = BAOptions.model_validate({"start_focals": (1.2,), "rolling_shutter": "no"})
    caplog.set_level("INFO", logger="motionsplat")
    found = estimate(Problem(graph, masked=False), options)
    told = [(int(k), int(n)) for k, n in re.findall(r"adjusting, [^:\n]+: (\d+) of (\d+)$", caplog.text, re.MULTILINE)]
    assert len(told) > 10
    assert all(k <= n for k, n in told)
    assert path_error(found.state.cam_from_world, truth) < 2e-4
    assert found.state.focal_px == pytest.approx(FOCAL_PX, rel=2e-3)
    assert sum(edges for edges, _ in visited) < 90 * len(graph.source)
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


def test_a_zoom_is_told_from_more_than_a_hundred_frames() -> None:
    """And a part of them, spread over the clip, suffices for the predicted error of its change."""
    frames = zoom.COMPARED + 10
    curve = np.exp(0.15 * np.sin(np.arange(frames) / 30))
    graph, truth = clip(frames, 2 * STRIDE, curve)
    fixed = State(truth, np.full((frames, len(graph.pixels)), 0.5), FOCAL_PX)
    evidence, best = zoom.weigh(graph, fixed, list, FocalPrior(FOCAL_PX))
    assert evidence.decision == "changing", evidence.reason
    assert evidence.change == pytest.approx(np.log(curve.max() / curve.min()), rel=0.05)
    assert evidence.change_sigma is not None
    assert 0 < evidence.change_sigma < zoom.MAX_SIGMA
    np.testing.assert_allclose(best.focals_px, FOCAL_PX * curve, rtol=0.03)


@pytest.mark.parametrize("case", ["seen", "short", "noise", "blind"])
def test_the_focal_length_of_a_part_is_taken_where_the_part_shows_it(
    case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise those remain that are to be tried."""
    graph, truth = clip(FRAMES if case == "short" else T, 2 * STRIDE)
    if case == "noise":
        matches = graph.matches + 20 * np.random.default_rng(0).standard_normal(graph.matches.shape)
        graph = replace(graph, matches=matches.astype(np.float32))
    if case == "blind":  # as of a camera that moves straight ahead
        monkeypatch.setattr(first_focal, "focal_sigma", lambda *_: 0.06)

    def starting(_: Any) -> SimpleNamespace:
        return SimpleNamespace(state=State(truth[:FRAMES], np.full((FRAMES, len(graph.pixels)), 0.5), 1.1 * FOCAL_PX))

    monkeypatch.setattr(first_focal, "best_part", lambda _: slice(0, FRAMES))
    monkeypatch.setattr(first_focal, "guess", lambda *_: [])
    monkeypatch.setattr(first_focal.initialise, "choose", starting)
    tried = [0.8 * FOCAL_PX, 1.1 * FOCAL_PX]
    statistics = classify.Statistics(*(1.0,) * len(classify.Statistics.__dataclass_fields__))
    observed = Observed(graph, graph, None, tried, statistics, FocalPrior(FOCAL_PX), 0)
    found = first_focal.focals_of_part(observed)
    assert found == (pytest.approx([FOCAL_PX], rel=0.02) if case == "seen" else tried)
