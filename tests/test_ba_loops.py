"""Closing of loops: a path that has drifted is closed, and a wrong loop is left out."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from synthetic import Scene, exact_flow, make_scene, trajectory_error

from stages.ba import loops, similarities
from stages.ba.classify import longest_step
from stages.ba.dba import FocalPrior, State, Unknowns, errors_px
from stages.ba.estimate import estimate
from stages.ba.graph import FlowGraph, build_graph
from stages.ba.options import BAOptions
from stages.ba.problem import Problem
from stages.ba.weights import favour_distance
from stages.shared import lie

T, LAP, STRIDE = 76, 68, 4
HALL = tuple(
    (tuple(sign * axis), 3.0 + 0.4 * k) for k, (sign, axis) in enumerate((s, a) for a in np.eye(3) for s in (1, -1))
)
"""The inside of a box."""
LOOPS = [(i, i + LAP) for i in range(0, T - LAP, 2)]


@pytest.fixture(scope="module")
def walk() -> Scene:
    """A circle in a hall, looking outward, and a little more than one lap of it."""
    angle = 2 * np.pi * np.arange(T) / LAP
    R = lie.exp_so3(angle[:, None] * [0.0, 1.0, 0.0])
    centres = np.stack([np.cos(angle) - 1, 0.2 * np.sin(2 * angle), np.sin(angle)], axis=1)
    return make_scene(T=T, size=(48, 64), path=lie.from_parts(R, -np.einsum("nab,nb->na", R, centres)), planes=HALL)


def observed(walk: Scene, wrong: tuple[int, int] | None = None) -> FlowGraph:
    """Exact flow between near frames and over the loops; `wrong`: a pair whose flow is that to another place."""
    pairs = [*LOOPS, *([wrong] if wrong else [])]
    near = {(i, j) for i in range(T) for j in range(T) if abs(i - j) in (1, 2, 4)}
    edges = sorted(near | {edge for i, j in pairs for edge in ((i, j), (j, i))})
    instead = {wrong: (wrong[0], wrong[0] + 3), wrong[::-1]: (wrong[1], wrong[1] - 3)} if wrong else {}
    flow, seen = zip(*(exact_flow(walk, *instead.get(edge, edge)) for edge in edges), strict=True)
    source, target = np.array(edges).T
    return build_graph(source, target, np.stack(flow).astype(np.float32), np.stack(seen).astype(np.float32), T, STRIDE)


def drifted(walk: Scene, graph: FlowGraph) -> State:
    """The true state, but that every step is a bit too long, the scale shrinks and the camera turns too far."""
    relative = walk.cam_from_world[1:] @ lie.inverse(walk.cam_from_world[:-1])
    scale = 0.998 ** np.arange(T)
    poses = [np.eye(4)]
    for k, motion in enumerate(relative):
        step = lie.exp_se3(np.array([0, 0, 0, 0, 4e-4, 2e-4])) @ motion
        step[:3, 3] *= scale[k]
        poses.append(step @ poses[-1])
    depth = graph.resample(1 / walk.depth, 1) / scale[:, None]
    return State(np.stack(poses), depth, walk.focal_px)


def test_the_drift_of_a_walk_is_spread_when_it_returns(walk: Scene) -> None:
    graph = observed(walk)
    state = drifted(walk, graph)
    assert trajectory_error(state.cam_from_world, walk.cam_from_world) > 4e-3
    closed = loops.close(graph, state, Unknowns(), FocalPrior(walk.focal_px))
    assert trajectory_error(closed.state.cam_from_world, walk.cam_from_world) < 5e-4
    assert closed.facts["loops"] == len(LOOPS)
    assert closed.facts["loops_left_out"] == 0
    assert 0.5 < closed.facts["loop_gap_percent"] < 10
    far = np.abs(graph.target - graph.source) > LAP - 1
    assert np.median(errors_px(graph, state)[far][graph.weights[far] > 0.5]) > 2
    assert np.median(errors_px(graph, closed.state)[far][graph.weights[far] > 0.5]) < 0.3


def test_the_estimate_closes_the_loops_and_counts_them(walk: Scene) -> None:
    """Flow between near frames is a per cent too short, so that the path drifts; that of the loops is exact."""
    graph = observed(walk)
    length = graph.target - graph.source
    near, pulled = np.abs(length) < LAP, graph.pixels[None] + (graph.matches - graph.pixels) * 0.99
    graph = replace(graph, matches=np.where(near[:, None, None], pulled, graph.matches).astype(np.float32))
    alone = replace(graph, weights=graph.weights * near[:, None])
    options = BAOptions(start_focals=(walk.focal_px / graph.width,))
    drifts, closed = (estimate(Problem(g, True, known_focal_px=walk.focal_px), options) for g in (alone, graph))
    errors = [trajectory_error(found.state.cam_from_world, walk.cam_from_world) for found in (drifts, closed)]
    assert closed.statistics["loops"] == len(LOOPS)
    assert errors[1] < errors[0] / 2


def test_a_wrong_loop_is_left_out_and_bends_nothing(walk: Scene) -> None:
    graph = observed(walk, wrong=(3, 70))
    closed = loops.close(graph, drifted(walk, graph), Unknowns(), FocalPrior(walk.focal_px))
    assert closed.facts["loops_left_out"] == 1
    assert trajectory_error(closed.state.cam_from_world, walk.cam_from_world) < 5e-4
    wrong = graph.edge(3, 70)
    assert wrong is not None
    assert not closed.graph.weights[wrong].any()


def test_absurd_loops_do_not_make_the_spreading_diverge(walk: Scene) -> None:
    """Resections of wrong matches can be turned by any angle and off by any scale."""
    poses, rng = drifted(walk, observed(walk)).cam_from_world, np.random.default_rng(0)
    ends = np.array([*LOOPS, (1, 70), (2, 72), (5, 74)])
    true = walk.cam_from_world[ends[:, 1]] @ lie.inverse(walk.cam_from_world)[ends[:, 0]]
    R, t, s = true[:, :3, :3], true[:, :3, 3].copy(), np.ones(len(ends))
    R[-3:], t[-3:], s[-3:] = lie.exp_so3(rng.normal(0, 1.5, (3, 3))), rng.normal(0, 5, (3, 3)), np.exp([4.0, -4.0, 2.0])
    found, weights = loops.spread(poses, ends, similarities.Similarities(s, R, t))
    closed = lie.from_parts(found.R, found.t / found.s[:, None])
    assert (weights > 0.5).tolist() == [True] * len(LOOPS) + [False] * 3
    assert trajectory_error(closed, walk.cam_from_world) < 3e-3 < 4e-3 < trajectory_error(poses, walk.cam_from_world)


def test_a_clip_without_loops_stays_as_it_is(walk: Scene) -> None:
    graph = observed(walk)
    near = np.abs(graph.target - graph.source) < LAP
    pointer = np.searchsorted(graph.source[near], np.arange(T + 1))
    parts = {name: getattr(graph, name)[near] for name in ("source", "target", "matches", "weights")}
    plain = replace(graph, pointer=pointer, **parts)
    state = drifted(walk, plain)
    closed = loops.close(plain, state, Unknowns(), FocalPrior(walk.focal_px))
    assert closed.graph is plain
    assert closed.state is state
    assert not closed.facts


def test_loops_neither_set_the_step_of_a_chain_nor_outweigh_all_else(walk: Scene) -> None:
    graph = observed(walk)
    assert longest_step(graph) == 4
    weights = favour_distance(graph).weights.max(axis=1)
    assert weights[np.abs(graph.target - graph.source) == LAP].max() / weights.min() == pytest.approx(64, rel=1e-3)


def test_similarities_compose_invert_and_carry_steps_across() -> None:
    rng = np.random.default_rng(0)
    twists = rng.normal(size=(2, 5, 7))
    one, two = (similarities.Similarities(np.exp(x[:, 6]), lie.exp_so3(x[:, 3:6]), x[:, :3]) for x in twists)
    points = rng.normal(size=(5, 3))

    def moved(by: similarities.Similarities, x: np.ndarray) -> np.ndarray:
        return by.s[:, None] * np.einsum("nab,nb->na", by.R, x) + by.t

    assert_allclose(moved(one @ two, points), moved(one, moved(two, points)), atol=1e-12)
    assert_allclose(moved(one.inverse(), moved(one, points)), points, atol=1e-12)
    small = 1e-6 * rng.normal(size=(5, 7))
    right = similarities.Similarities(np.exp(small[:, 6]), lie.exp_so3(small[:, 3:6]), small[:, :3])
    across = (one @ right @ one.inverse()).log()
    assert_allclose(across, np.einsum("nab,nb->na", one.adjoint(), small), atol=1e-10)
