"""Hard cases of bundle adjustment: nothing to see, nothing to tell apart, and scales far from one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ba_files import outputs, write_inputs
from numpy.testing import assert_allclose
from synthetic import PLANE, flow_arrays, make_scene, observe, rotation_error_deg, trajectory_error

from stages.ba import arguments, classify, dba, residuals, twoview
from stages.ba.__main__ import main
from stages.ba.dense_system import DenseSystem
from stages.ba.depth import depth_maps, fill
from stages.ba.estimate import estimate
from stages.ba.graph import FlowGraph, build_graph, static_areas, trusted_static_areas
from stages.ba.guesses import PoseGuess
from stages.ba.normal_equations import normal_equations
from stages.ba.options import BAOptions
from stages.ba.problem import Estimate, Problem
from stages.ba.proposal import linear_system
from stages.ba.state import DEPTH_PRIOR, FocalPrior, Level, State, Unknowns
from stages.ba.weights import mask_graph
from stages.shared import lie
from stages.shared.artifacts import read_dense, read_metadata
from stages.shared.cameras import read_cameras

OPTIONS = BAOptions()


def is_finite(solution: Estimate) -> bool:
    """Whether everything that is written to the artifacts is a number."""
    state = solution.state
    arrays = (state.cam_from_world, state.inverse_depth, solution.covariance, np.array(state.focal_px))
    return all(np.isfinite(array).all() for array in arrays)


def dense_system(graph: FlowGraph, state: State) -> tuple[np.ndarray, np.ndarray]:
    """The reduced system with one free focal length, and its right-hand side."""
    system = linear_system(graph, state, 1.0, Unknowns(focal=True))
    assert isinstance(system, DenseSystem)
    return system.S, system.rhs


def test_schur_complement_with_no_valid_pixel_leaves_only_the_prior() -> None:
    scene = make_scene(T=3, size=(24, 32))
    graph = observe(scene, stride=8)
    graph = replace(graph, weights=np.zeros_like(graph.weights))
    state = State(scene.cam_from_world, np.ones((3, len(graph.pixels))), scene.focal_px)
    S, rhs = dense_system(graph, state)
    assert_allclose(S, 0)
    assert_allclose(rhs, 0)
    solved, steps = dba.solve(graph, state, (Level(1.0, 5),), Unknowns(focal=True), FocalPrior(20.0), "test")
    assert np.isfinite(solved.inverse_depth).all()
    assert all(np.isfinite(step.cost) for step in steps)


def test_schur_complement_of_one_frame_is_empty() -> None:
    none = np.zeros(0, np.int64)
    flow, confidence = np.zeros((1, 16, 16, 2), np.float32), np.zeros((1, 16, 16), np.float32)
    graph = build_graph(np.zeros(1, np.int64), np.ones(1, np.int64), flow, confidence, 2, 8)
    lonely = replace(
        graph,
        source=none,
        target=none,
        pointer=np.zeros(2, np.int64),
        matches=graph.matches[:0],
        weights=graph.weights[:0],
    )
    state = State(np.eye(4)[None], np.ones((1, len(graph.pixels))), 20.0)
    S, rhs = dense_system(lonely, state)
    assert S.shape == (7, 7)
    assert_allclose(S, 0)
    assert_allclose(rhs, 0)


def test_two_equal_frames_keep_the_same_pose() -> None:
    scene = make_scene(size=(64, 96))
    poses = scene.cam_from_world.copy()
    twin = replace(
        scene, cam_from_world=np.insert(poses, 3, poses[3], axis=0), dynamic=np.insert(scene.dynamic, 3, False, 0)
    )
    twin = replace(twin, depth=np.insert(scene.depth, 3, scene.depth[3], axis=0))
    solution = estimate(Problem(observe(twin), masked=True, known_focal_px=scene.focal_px), OPTIONS)
    assert trajectory_error(solution.state.cam_from_world, twin.cam_from_world) < 2e-3
    step = solution.state.cam_from_world[4] @ lie.inverse(solution.state.cam_from_world[3])
    path = np.linalg.norm(solution.state.cam_from_world[-1, :3, 3])
    assert np.linalg.norm(step[:3, 3]) < 1e-3 * path


def test_zero_parallax_is_a_camera_at_rest_and_not_a_division_by_zero() -> None:
    scene = make_scene(T=5, size=(64, 96))
    flow = np.zeros((14, 64, 96, 2), np.float32)
    source, target, _, _ = flow_arrays(scene, (1, 2))
    graph = build_graph(source, target, flow, np.ones(flow.shape[:3], np.float32), 5, 4)
    solution = estimate(Problem(graph, masked=True), OPTIONS)
    assert solution.camera == "near-still"
    assert solution.focal["decision"] == "held at prior"
    assert is_finite(solution)
    assert rotation_error_deg(solution.state.cam_from_world, np.tile(np.eye(4), (5, 1, 1))) < 0.01


def test_a_path_with_little_parallax_is_no_rotation() -> None:
    """A camera follows something before a wall at an angle: two-view residuals alone would call it a rotation."""
    path = lie.exp_se3(np.arange(10)[:, None] * np.array([0.04, 0, 0, 0, 0.03, 0]))
    scene = make_scene(T=10, size=(96, 160), path=path, planes=(((0.5, -0.05, 1.0), 6.0),))
    problem = Problem(observe(scene, noise_px=0.02), masked=True, known_focal_px=scene.focal_px)
    assert classify.measure(problem.graph, scene.focal_px, 0).camera == "rotating"
    solution = estimate(problem, OPTIONS)
    assert solution.camera == "moving"
    assert trajectory_error(solution.state.cam_from_world, path) < 0.01


def test_a_shaking_dolly_towards_a_plane_does_not_turn_and_zoom() -> None:
    """Its path is rough, but explains the matches, of which rotations and a zoom leave four times as much."""
    twists = np.arange(12)[:, None] * np.array([0.01, 0, -0.05, 0, -0.012, 0])
    twists[1:, :3] += 0.03 * np.random.default_rng(0).standard_normal((11, 3))
    scene = make_scene(T=12, path=lie.exp_se3(twists), planes=PLANE)
    problem = Problem(observe(scene, offsets=(1, 2, 4), noise_px=0.03), masked=False)
    solution = estimate(problem, BAOptions(start_focals=(1.05,)))
    assert solution.camera == "moving"
    assert [flag for flag in solution.flags if "rough camera path" in flag]
    assert solution.state.focal_px == pytest.approx(scene.focal_px, rel=0.01)


@pytest.mark.parametrize("noise_px", [0.0, 0.1])
def test_pure_rotation_takes_no_translation_from_noise(noise_px: float) -> None:
    scene = make_scene(motion="rotate")
    solution = estimate(Problem(observe(scene, noise_px=noise_px), masked=True), OPTIONS)
    assert solution.camera == "rotating"
    assert is_finite(solution)
    # The naive model invents a path: a chain of essential matrices has unit translations.
    assert np.all(solution.state.cam_from_world[:, :3, 3] == 0)


@pytest.mark.parametrize(
    ("slowness", "camera"), [(1.0, "moving"), (0.25, "moving"), (0.12, "rotating"), (0.0, "rotating")]
)
def test_a_slow_dolly_while_panning_is_no_rotation(slowness: float, camera: str) -> None:
    """Over five frames a rotation explains all but the noise; taken for one, the focal length absorbs the travel.

    At a quarter of the speed only the residuals of a path beside it tell; at an eighth noise hides the travel.
    """
    scene = make_scene(T=16, motion="drift", travel=slowness)
    graph = observe(scene, offsets=(1, 4, 15), stride=6, noise_px=0.03)
    solution = estimate(Problem(graph, masked=False), OPTIONS)
    assert solution.camera == camera
    assert solution.state.focal_px == pytest.approx(scene.focal_px, rel=0.01)
    if camera == "moving":
        assert trajectory_error(solution.state.cam_from_world, scene.cam_from_world) < 5e-3


def test_a_planar_scene_is_named_and_solved() -> None:
    scene = make_scene(size=(96, 160), planes=PLANE)
    graph = observe(scene, noise_px=0.05)
    solution = estimate(Problem(graph, masked=True, known_focal_px=scene.focal_px), OPTIONS)
    assert solution.statistics["planar"]
    assert any("planar" in flag for flag in solution.flags)
    assert trajectory_error(solution.state.cam_from_world, scene.cam_from_world) < 5e-3
    room = observe(make_scene(size=(96, 160)), noise_px=0.05)
    assert not classify.measure(room, scene.focal_px, 0).planar


def test_points_at_infinity_turn_with_the_camera() -> None:
    scene = make_scene(T=3, size=(24, 32), motion="rotate")
    graph = observe(scene, stride=4)
    state = State(scene.cam_from_world, np.zeros((3, len(graph.pixels))), scene.focal_px)
    assert dba.errors_px(graph, state)[graph.weights > 0].max() < 1e-3
    data, at = arguments.observations(graph), arguments.geometry(graph, state)
    hessians, schur, *_ = normal_equations(data, at, 1.0, 0.0, DEPTH_PRIOR)
    assert np.isfinite(hessians).all()
    assert np.isfinite(schur).all()


def test_points_at_the_target_camera_count_as_outliers_and_not_as_infinities() -> None:
    scene = make_scene(T=3, size=(24, 32))
    graph = observe(scene, stride=4)
    poses = scene.cam_from_world.copy()
    poses[1, :3, 3] = [0.0, 0.0, -1.0]
    state = State(poses, np.ones((3, len(graph.pixels))), scene.focal_px)
    errors = dba.errors_px(graph, state)
    assert errors[graph.edge(0, 1)].min() == residuals.BEHIND_PX
    assert np.isfinite(dba.robust_cost(graph, errors, 1.0))
    S, rhs = dense_system(graph, state)
    assert np.isfinite(S).all()
    assert np.isfinite(rhs).all()


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_the_unit_of_length_changes_nothing(scale: float) -> None:
    """The round before may have measured in any unit."""
    solutions = []
    for unit in (1.0, scale):
        scene = make_scene(T=6, scale=unit)
        previous = PoseGuess(scene.cam_from_world, scene.focal_px)
        solutions.append(estimate(Problem(observe(scene, noise_px=0.1), True, previous=previous), OPTIONS).state)
    assert_allclose(solutions[1].cam_from_world, solutions[0].cam_from_world, atol=1e-5)
    assert solutions[1].focal_px == pytest.approx(solutions[0].focal_px, rel=1e-4)


def test_textureless_frames_fail_openly() -> None:
    """Without texture flow is zero and agrees with itself: only its confidence says that nothing was seen."""
    graph = observe(make_scene(T=4), offsets=(1,))
    guessed = {"matches": 0 * graph.matches + graph.pixels.astype(np.float32), "weights": 0 * graph.weights + 0.45}
    solution = estimate(Problem(replace(graph, **guessed), masked=False), OPTIONS)
    assert solution.camera == "failed"
    assert "failed" in solution.flags[0]
    assert_allclose(solution.state.cam_from_world, np.tile(np.eye(4), (4, 1, 1)))
    assert np.isfinite(solution.state.focal_px)


def test_a_frame_without_matches_is_bridged_and_named() -> None:
    scene = make_scene(T=8)
    graph = observe(scene, offsets=(1, 2, 3))
    weights = graph.weights.copy()
    weights[(graph.source == 4) | (graph.target == 4)] = 0
    blind = replace(graph, weights=weights)
    assert not blind.observed_frames()[4]
    solution = estimate(Problem(blind, masked=True, known_focal_px=scene.focal_px), OPTIONS)
    others = np.arange(8) != 4
    assert is_finite(solution)
    assert trajectory_error(solution.state.cam_from_world[others], scene.cam_from_world[others]) < 2e-2


def test_masks_over_the_whole_image_are_ignored_and_an_empty_mask_is_normal() -> None:
    masks = np.zeros((4, 64, 96), bool)
    masks[2] = True
    static, dropped = trusted_static_areas(static_areas(masks, 48, 32))
    assert dropped.tolist() == [False, False, True, False]
    assert (static == 1).all()


@pytest.mark.parametrize(("dynamic", "confident", "status"), [(True, 1, "estimated"), (False, 0, "failed")])
def test_the_script_survives_and_says_so(tmp_path: Path, dynamic: bool, confident: int, status: str) -> None:
    source, target, flow, confidence = flow_arrays(make_scene(T=4, size=(48, 64)), (1, 2))
    files = write_inputs(tmp_path, (source, target, flow, confident * confidence), np.full((4, 48, 64), dynamic))
    main(**files, **(paths := outputs(tmp_path / "out")), options=BAOptions(stride_px=4))
    cameras, depth = read_cameras(paths["poses"]), read_dense(paths["depth"])
    assert set(cameras.status) == {status}
    assert read_metadata(paths["poses"])["flags"]
    assert np.isfinite(cameras.cam_from_world).all()
    assert (depth["inverse_depth"] > 0).all()
    assert np.isfinite(depth["variance"]).all()


def test_depth_without_any_measured_pixel_is_filled() -> None:
    shape = (6, 8)
    assert_allclose(fill(np.full(shape, 3.0), np.ones(shape, bool)), 1.0)
    scene = make_scene(T=3, size=(24, 32), motion="rotate")
    graph = observe(scene, stride=4)
    state = State(scene.cam_from_world, np.zeros((3, len(graph.pixels))), scene.focal_px)
    maps = depth_maps(graph, graph, state, np.ones((3, 24, 32), np.float32), observable=False)
    assert maps.filled.all()
    assert (maps.inverse_depth == 1).all()


def test_covariance_of_an_unseen_direction_is_large_and_finite() -> None:
    scene = make_scene(T=3, size=(24, 32))
    graph = observe(scene, offsets=(1,), stride=8)
    weights = graph.weights.copy()
    weights[(graph.source == 2) | (graph.target == 2)] = 0
    state = State(scene.cam_from_world, np.ones((3, len(graph.pixels))), scene.focal_px)
    covariance = linear_system(replace(graph, weights=weights), state, 1.0, Unknowns()).covariance().poses(3)
    assert np.isfinite(covariance).all()
    assert covariance[2, 0, 0] > 1e3 * covariance[1, 3, 3]


def test_a_rotation_fit_to_identical_points_is_the_identity() -> None:
    x = np.full((60, 2), 0.1)
    R, residual = twoview.fit_rotation(x, x, np.ones(60), 100.0)
    assert_allclose(R, np.eye(3), atol=1e-9)
    assert_allclose(residual, 0, atol=1e-9)


def test_too_few_matches_give_no_motion() -> None:
    x = np.random.default_rng(0).normal(size=(10, 2))
    assert twoview.estimate_motion(x, x, np.ones(10), 100.0, 0.5, 0) is None


def test_masks_that_hide_the_static_scene_are_distrusted() -> None:
    scene = make_scene(size=(96, 160), disc_radius=0.5)
    everything = observe(scene, masked=False)
    hidden = mask_graph(everything, np.zeros_like(scene.depth))
    problem = Problem(hidden, masked=True, known_focal_px=scene.focal_px)
    assert estimate(problem, OPTIONS).camera == "failed"
    solution = estimate(replace(problem, unmasked=everything), OPTIONS)
    assert solution.camera == "moving"
    assert "masks ignored" in solution.flags[0]
    assert trajectory_error(solution.state.cam_from_world, scene.cam_from_world) < 0.02
