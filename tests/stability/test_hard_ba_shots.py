"""Sequences that are no single shot: cuts, and frames that show nothing. Matches across them are chance."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ba_files import outputs, write_inputs
from numpy.testing import assert_allclose, assert_array_equal
from synthetic import PLANE, Scene, flow_arrays, make_scene, trajectory_error

from stages.ba import cuts
from stages.ba.__main__ import main
from stages.ba.graph import FlowGraph, build_graph, cut_out
from stages.ba.initialise import Hypothesis, chain, initial_state
from stages.ba.options import BAOptions
from stages.ba.problem import Problem
from stages.ba.proposal import linear_system
from stages.ba.state import Unknowns
from stages.shared.artifacts import read_dense, read_metadata
from stages.shared.cameras import read_cameras

OFFSETS = (1, 2, 3)
GUESSED = 0.45
"""Confidence of flow without texture."""


def glued(first: Scene, second: Scene) -> tuple[np.ndarray, ...]:
    """Edges of two scenes one after the other; between them a few matches by chance, of no motion."""
    T, pixels = first.T + second.T, first.depth[0].shape
    pairs = [(i, j) for i in range(T) for j in range(T) if abs(i - j) in OFFSETS]
    source, target = np.array(pairs).T
    flow, confidence = np.zeros((len(pairs), *pixels, 2), np.float32), np.zeros((len(pairs), *pixels), np.float32)
    confidence[:, :8, :16] = 1
    for scene, start in ((first, 0), (second, first.T)):
        inner = [k for k, (i, j) in enumerate(pairs) if start <= min(i, j) and max(i, j) < start + scene.T]
        _, _, flow[inner], confidence[inner] = flow_arrays(scene, OFFSETS)
    return source, target, flow, confidence


def blind_at(scene: Scene, frames: list[int]) -> tuple[np.ndarray, ...]:
    """Edges of a scene some frames of which are black: their flow is zero, as sure as without texture."""
    source, target, flow, confidence = flow_arrays(scene, OFFSETS)
    blind = np.isin(source, frames) | np.isin(target, frames)
    both = np.isin(source, frames) & np.isin(target, frames)
    flow[blind], confidence[blind] = 0, 0
    confidence[both] = GUESSED
    return source, target, flow, confidence


def graph_of(edges: tuple[np.ndarray, ...], T: int) -> tuple[FlowGraph, np.ndarray]:
    """The graph of the longest shot, and its frames [T]."""
    graph = build_graph(*edges, T, 4)
    frames = cuts.linked_frames(graph.source, graph.target, graph.weights, T)
    return cuts.isolate(graph, frames), frames


@pytest.mark.parametrize("longest_first", [True, False])
def test_of_a_cut_sequence_the_longest_shot_is_solved_alone(longest_first: bool) -> None:
    long, short = make_scene(T=7), make_scene(T=5, planes=PLANE, motion="rotate")
    edges = glued(long, short) if longest_first else glued(short, long)
    graph, frames = graph_of(edges, 12)
    inside = slice(0, 7) if longest_first else slice(5, 12)
    assert_array_equal(np.flatnonzero(frames), np.arange(12)[inside])
    assert not graph.weights[~(frames[graph.source] & frames[graph.target])].any()
    solution = cuts.estimate_shot(Problem(graph, masked=True, known_focal_px=long.focal_px), frames, BAOptions())
    poses, covariance = solution.state.cam_from_world, solution.covariance
    assert trajectory_error(poses[inside], long.cam_from_world) < 2e-3
    assert_array_equal(poses[0], np.eye(4))
    assert_array_equal(poses[~frames], np.broadcast_to(poses[inside][-1 if longest_first else 0], (5, 4, 4)))
    assert covariance[~frames, 0, 0].min() > 1e3 * covariance[frames].max()


def test_black_frames_amid_others_are_bridged_and_known_to_be_unobserved() -> None:
    scene = make_scene(T=10)
    graph, frames = graph_of(blind_at(scene, [4, 5]), 10)
    assert_array_equal(np.flatnonzero(~frames), [4, 5])
    assert_array_equal(graph.observed_frames(), frames)
    solution = cuts.estimate_shot(Problem(graph, masked=True, known_focal_px=scene.focal_px), frames, BAOptions())
    poses, covariance = solution.state.cam_from_world, solution.covariance
    assert trajectory_error(poses[frames], scene.cam_from_world[frames]) < 2e-3
    assert trajectory_error(poses, scene.cam_from_world) < 2e-3
    assert covariance[~frames, 0, 0].min() > 1e3 * covariance[frames].max()


def test_a_chain_goes_on_behind_a_gap_at_the_scale_before_it() -> None:
    """Matches over a gap of k frames show k times the motion of the pair before it: no measure of the one behind it."""
    scene = make_scene(T=10)
    graph, _ = graph_of(blind_at(scene, [4]), 10)
    poses = chain(graph, Hypothesis(scene.focal_px, 0.2), seed=0)
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert_allclose(steps / steps[0], 1, atol=0.2)


def test_a_blind_frame_does_not_take_up_the_size_of_the_trajectory() -> None:
    scene, sigmas = make_scene(T=8), []
    for hidden in ([], [4]):
        graph, frames = graph_of(blind_at(scene, hidden), 8)
        state = initial_state(graph, scene.cam_from_world, scene.focal_px)
        covariance = linear_system(graph, state, 1.0, Unknowns()).covariance().poses(8)
        sigmas.append(np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)))
    assert sigmas[1][frames].max() < 2 * sigmas[0].max()
    assert sigmas[1][4].min() > 1e3 * sigmas[0].max()


@pytest.mark.parametrize("weight", [0.0, GUESSED])
def test_nothing_seen_is_no_shot(weight: float) -> None:
    source, target, _, confidence = flow_arrays(make_scene(T=4), (1,))
    weights = np.full((len(source), confidence[0].size), weight)
    assert cuts.linked_frames(source, target, weights, 4).all()
    weights[:2] = 1  # two frames linked by chance
    assert cuts.linked_frames(source, target, weights, 4).all()


@pytest.mark.parametrize(
    ("case", "status", "said"),
    [
        ("cut", ["estimated"] * 5 + ["unobserved"] * 4, "frames 6-9 "),
        ("black amid", ["estimated"] * 4 + ["unobserved"] + ["estimated"] * 4, "frames 5 "),
        ("black", ["failed"] * 9, "failed"),
    ],
)
def test_the_script_names_frames_without_a_pose(tmp_path: Path, case: str, status: list[str], said: str) -> None:
    if case == "cut":
        edges = glued(make_scene(T=5), make_scene(T=4, planes=PLANE))
    else:
        edges = blind_at(make_scene(T=9), [4] if case == "black amid" else list(range(9)))
    files, paths = write_inputs(tmp_path, edges, np.zeros((9, 64, 96), bool)), outputs(tmp_path / "out")
    main(**files, **paths, options=BAOptions(stride_px=4))
    cameras, metadata = read_cameras(paths["poses"]), read_metadata(paths["poses"])
    assert list(cameras.status) == status
    assert any(said in flag for flag in metadata["flags"])
    assert np.isfinite(cameras.cam_from_world).all()
    assert read_dense(paths["depth"])["filled"][np.array(status) != "estimated"].all()


def test_numbers_of_frames_left_out_are_named_in_runs() -> None:
    kept = np.array([False, True, False, False, True, False])
    [flag] = cuts.warnings(kept, [3, 4, 5, 6, 7, 20])
    assert "frames 3, 5-6, 20 " in flag
    assert cuts.warnings(np.ones(6, bool), [3, 4, 5, 6, 7, 20]) == []


def test_texture_and_earlier_poses_are_cut_out_with_their_frames() -> None:
    long, short = make_scene(T=7), make_scene(T=4, planes=PLANE)
    graph, _ = graph_of(glued(short, long), 11)
    graph = replace(graph, texture=np.arange(11, dtype=np.float32)[:, None] * np.ones_like(graph.weights[:11]))
    part = cut_out(graph, slice(4, 11))
    assert_array_equal(part.texture[:, 0], np.arange(4, 11))
    assert (part.T, part.edge(0, 3)) == (7, 2)
    assert_array_equal(part.matches[part.edge(2, 1)], graph.matches[graph.edge(6, 5)])
