"""Where bundle adjustment starts and what it measures: two-view motion, chains, special cameras, depth."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from synthetic import Scene, camera_path, make_scene, observe, rotation_error_deg, trajectory_error

from stages.ba import classify, dba, two_motions, twoview
from stages.ba.depth import depth_maps, joined
from stages.ba.estimate import estimate
from stages.ba.graph import FlowGraph, static_areas
from stages.ba.guesses import PoseGuess
from stages.ba.initialise import Hypothesis, chain, initial_state
from stages.ba.options import BAOptions
from stages.ba.problem import Problem
from stages.ba.refinement import CONSISTENT_SHARE, consistent_share
from stages.ba.state import FocalPrior, Level, State, Unknowns
from stages.ba.uncertainty import focal_sigma
from stages.shared import lie

OPTIONS = BAOptions()


def true_state(scene: Scene, graph: FlowGraph) -> State:
    """The exact solution on a graph."""
    return State(scene.cam_from_world, graph.resample(1 / scene.depth, 1), scene.focal_px)


def test_sampson_normal_equations_equal_those_of_finite_differences() -> None:
    rng = np.random.default_rng(0)
    x, y, w = rng.normal(0, 0.3, (20, 2)), rng.normal(0, 0.3, (20, 2)), rng.uniform(0, 1, 20)
    R, t, sigma = lie.exp_so3(np.array([0.1, -0.2, 0.05])), np.array([0.6, 0.0, 0.8]), 0.1
    basis, h, J = twoview._tangent_basis(t), 1e-6, np.zeros((20, 5))
    for k in range(5):
        step = h * np.eye(5)[k]
        ends = [twoview.sampson_errors(lie.exp_so3(s * step[:3]) @ R, t + s * step[3:] @ basis, x, y) for s in (1, -1)]
        J[:, k] = (ends[0] - ends[1]) / (2 * h)
    residual = twoview.sampson_errors(R, t, x, y)
    robust = w / (1 + (residual / sigma) ** 2) ** 2
    normal, gradient = twoview._sampson_system(R, t, basis, x, y, w, sigma)
    assert_allclose(normal, J.T @ (J * robust[:, None]), atol=1e-7)
    assert_allclose(gradient, J.T @ (robust * residual), atol=1e-7)


def test_normal_equations_of_a_rotation_equal_those_of_finite_differences() -> None:
    rng = np.random.default_rng(0)
    x, y, w = rng.normal(0, 0.3, (20, 2)), rng.normal(0, 0.3, (20, 2)), rng.uniform(0, 1, 20)
    R, focal_px, level_px, h = lie.exp_so3(np.array([0.1, -0.2, 0.05])), 90.0, 20.0, 1e-6

    def left_px(turn: np.ndarray) -> np.ndarray:
        points = np.column_stack([x, np.ones(20)]) @ (lie.exp_so3(turn) @ R).T
        return (y - points[:, :2] / points[:, 2:]) * focal_px

    residual = left_px(np.zeros(3))
    J = np.stack([(left_px(-h * axis) - left_px(h * axis)) / (2 * h) for axis in np.eye(3)], axis=2)
    robust = w / (1 + (residual**2).sum(axis=1) / level_px**2) ** 2
    normal, rhs = twoview._rotation_system(R, x, y, w, focal_px, level_px)
    assert_allclose(normal, np.einsum("nci,n,ncj->ij", J, robust, J), rtol=1e-6, atol=1e-3)
    assert_allclose(rhs, np.einsum("nci,n,nc->i", J, robust, residual), rtol=1e-6, atol=1e-3)


def test_two_view_motion_survives_outliers_and_the_twisted_pair() -> None:
    rng = np.random.default_rng(0)
    R, t = lie.exp_so3(np.array([0.02, -0.05, 0.01])), np.array([0.9, 0.1, 0.42])
    t = t / np.linalg.norm(t)
    points = np.concatenate([rng.uniform(-2, 2, (400, 2)), rng.uniform(3, 9, (400, 1))], axis=1)
    moved = points @ R.T + 0.3 * t
    x, y = points[:, :2] / points[:, 2:], moved[:, :2] / moved[:, 2:]
    y[:120] += rng.normal(0, 0.05, (120, 2))
    fit = twoview.estimate_motion(x, y, np.ones(400), 400.0, 0.3, seed=0)
    assert fit is not None
    assert np.degrees(np.linalg.norm(lie.log_so3(fit.R.T @ R))) < 0.02
    assert np.degrees(np.arccos(fit.t @ t)) < 0.2
    d, _ = twoview.triangulate(fit.R, 0.3 * fit.t, x[120:], y[120:])
    assert_allclose(d * points[120:, 2], 1.0, rtol=0.02)


def test_a_fifth_of_moving_pixels_does_not_win_the_two_view_fit() -> None:
    scene = make_scene(size=(96, 160), disc_radius=0.5)
    assert scene.dynamic.mean() > 0.15
    x, y, w = twoview.pair_rays(observe(scene, masked=False), 3, 4, scene.focal_px)
    fit = twoview.estimate_motion(x, y, w, scene.focal_px, 0.3, seed=0)
    relative = scene.cam_from_world[4] @ lie.inverse(scene.cam_from_world[3])
    assert fit is not None
    assert np.degrees(np.linalg.norm(lie.log_so3(fit.R.T @ relative[:3, :3]))) < 0.05


def test_a_chain_of_exact_pairs_is_the_trajectory_up_to_scale() -> None:
    scene = make_scene(size=(96, 160))
    graph = observe(scene)
    poses = chain(graph, Hypothesis(scene.focal_px, 0.2), seed=0)
    assert trajectory_error(poses, scene.cam_from_world) < 0.02
    state = initial_state(graph, poses, scene.focal_px)
    truth = graph.resample(1 / scene.depth, 1)
    ratio = state.inverse_depth / truth
    seen = np.array([graph.weights[graph.source == i].sum(axis=0) for i in range(graph.T)]) > 1
    assert np.percentile(np.abs(ratio[seen] / np.median(ratio[seen]) - 1), 80) < 0.1


def test_a_rotating_camera_is_recognised_and_solved_without_translation() -> None:
    scene = make_scene(motion="rotate", size=(96, 160))
    solution = estimate(Problem(observe(scene, noise_px=0.1), masked=True), OPTIONS)
    assert solution.camera == "rotating"
    assert rotation_error_deg(solution.state.cam_from_world, scene.cam_from_world) < 0.01
    assert solution.state.focal_px == pytest.approx(scene.focal_px, rel=0.01)
    assert np.all(solution.state.cam_from_world[:, :3, 3] == 0)


@pytest.mark.parametrize(("focal", "noise_px"), [(0.72, 0.02), (1.22, 0.02), (1.9, 0.02), (1.05, 1.2)])
def test_a_pan_is_recognised_at_any_focal_length_and_noise(focal: float, noise_px: float) -> None:
    """No focal length of a list explains a wide pan to the noise, and noise alone may leave half a pixel."""
    scene = make_scene(motion="rotate", size=(160, 400), focal=focal)
    graph = observe(scene, offsets=(1, 5), stride=10, noise_px=noise_px)
    statistics = classify.measure(graph, None, 0)
    assert statistics.camera == "rotating"
    assert statistics.rotation_px == pytest.approx(classify.NOISE_RATIO * statistics.sampson_px, rel=0.25)


def test_a_pan_by_less_than_a_pixel_a_frame_is_no_path() -> None:
    """Solved with a path its focal length was up to a third wrong on rendered clips."""
    turns = np.column_stack([np.zeros((16, 4)), 0.004 * np.arange(16), np.zeros(16)])
    scene = make_scene(T=16, size=(96, 160), path=lie.exp_se3(turns), focal=0.8)
    graph = observe(scene, offsets=(1, 2, 4, 8), noise_px=0.02)
    solution = estimate(Problem(graph, masked=True), OPTIONS)
    assert solution.statistics["flow_px"] < 0.7
    assert (solution.camera, solution.focal["decision"]) == ("rotating", "estimated")
    assert solution.state.focal_px == pytest.approx(scene.focal_px, rel=0.03)


def test_a_slow_slide_past_a_wall_is_no_pan() -> None:
    """Turns explain it to the noise, at 4.1 times the focal length, which they leave open."""
    slide = np.column_stack([-0.012 * np.arange(16), np.zeros((16, 5))])
    scene = make_scene(T=16, size=(96, 160), path=lie.exp_se3(slide), focal=0.8, planes=(((0.1, 0.0, 1.0), 5.0),))
    graph = observe(scene, offsets=(1, 2, 4, 8), noise_px=0.1)
    assert classify.measure(graph, None, 0).camera == "rotating"
    solution = estimate(Problem(graph, masked=True), OPTIONS)
    assert (solution.camera, solution.focal["decision"]) == ("near-still", "held at prior")
    assert trajectory_error(solution.state.cam_from_world, scene.cam_from_world) < 0.02


@pytest.mark.parametrize("motion", ["curve", "drift"])
def test_noise_does_not_hide_that_a_camera_travels(motion: str) -> None:
    scene = make_scene(motion=motion, size=(160, 400), T=10)
    graph = observe(scene, offsets=(1, 5), stride=10, noise_px=0.3)
    assert classify.measure(graph, None, 0).camera == "moving"


def test_a_fast_camera_is_told_by_neighbours_where_only_the_distance_is_matched_further() -> None:
    """What it passes leaves the picture or blurs: over several frames a rotation explains what is left."""
    scene = make_scene(motion="curve", size=(160, 400), T=10)
    turning = scene.cam_from_world.copy()
    turning[:, :3, 3] = 0
    views = (scene, replace(scene, cam_from_world=turning))
    graph, turned = (observe(view, offsets=(1, 5), stride=10, noise_px=0.05) for view in views)
    far = (np.abs(graph.target - graph.source) > 1)[:, None, None]
    mixed = replace(graph, matches=np.where(far, turned.matches, graph.matches))
    statistics = classify.measure(mixed, scene.focal_px, 0)
    assert statistics.rotation_px < statistics.rotation_1_px
    assert statistics.camera == "moving"


def test_a_pan_is_not_taken_for_a_mover_that_it_follows() -> None:
    """Four matches in ten rest in the picture, where a fit that starts from no rotation stays."""
    rng, focal_px = np.random.default_rng(0), 400.0
    R = lie.exp_so3(np.array([0.01, -0.25, 0.0]))
    x = rng.uniform(-0.3, 0.3, (500, 2))
    turned = np.concatenate([x, np.ones((500, 1))], axis=1) @ R.T
    y = turned[:, :2] / turned[:, 2:]
    y[:200] = x[:200] + rng.normal(0, 0.1, 2) / focal_px
    found, residuals = twoview.fit_rotation(x, y, np.ones(500), focal_px)
    assert np.degrees(np.linalg.norm(lie.log_so3(found.T @ R))) < 0.01
    assert np.median(residuals[200:]) < 0.05


@pytest.mark.parametrize("size", [(96, 160), (160, 96)], ids=["landscape", "upright"])
def test_a_camera_too_still_to_show_its_focal_length_keeps_that_of_the_prior(size: tuple[int, int]) -> None:
    """The lens of a phone has the same angle along the longer side, however it is held."""
    scene = make_scene(motion="still", size=size)
    solution = estimate(Problem(observe(scene, noise_px=0.1), masked=True), OPTIONS)
    assert solution.camera == "near-still"
    assert solution.focal["decision"] == "held at prior"
    assert [flag for flag in solution.flags if flag.startswith("focal length held at prior: its predicted error")]
    assert solution.state.focal_px == pytest.approx(1.1 * 160)
    assert trajectory_error(solution.state.cam_from_world, scene.cam_from_world) < 0.05


@pytest.mark.parametrize(("T", "noise_px"), [(8, 0.01), (8, 0.02), (16, 0.02)])
def test_a_nearly_still_camera_has_the_focal_length_that_it_shows(T: int, noise_px: float) -> None:
    """Six per cent of a usual path. From the usual focal length alone, .3 of the right one away, eight frames ended at
    1.8 times the right one, with a predicted error of 5 %.
    """
    scene = make_scene(T=T, size=(96, 160), path=lie.exp_se3(0.06 * lie.log_se3(camera_path(T, "curve"))), focal=0.8)
    solution = estimate(Problem(observe(scene, noise_px=noise_px), masked=True), OPTIONS)
    assert (solution.camera, solution.focal["decision"]) == ("near-still", "estimated")
    assert abs(solution.state.focal_px / scene.focal_px - 1) < 0.04
    assert trajectory_error(solution.state.cam_from_world, scene.cam_from_world) < 0.05


def test_a_slow_mover_before_a_nearly_still_camera_does_not_decide_the_focal_length(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without masks yet: all flow is below a pixel, so a static scene seems to explain it. It ended at 2.5 times.

    Two motions tell the mover, by what fits both; where they do not, nothing tells it.
    """
    path = lie.exp_se3(0.06 * lie.log_se3(camera_path(8, "curve")))
    scene = make_scene(T=8, size=(96, 160), path=path, focal=1.1, disc_radius=0.5, velocity=(0.02, 0.005, 0.0))
    graph = observe(scene, noise_px=0.02, masked=False)
    told = estimate(Problem(graph, masked=False), OPTIONS)
    assert (told.camera, told.focal["decision"]) == ("near-still", "held at prior")
    assert told.static is not None
    assert told.static[scene.dynamic].mean() < 0.1
    assert told.static[~scene.dynamic].mean() > 0.8
    monkeypatch.setattr(two_motions, "background", lambda *_: None)
    solution = estimate(Problem(graph, masked=False), OPTIONS)
    assert (solution.camera, solution.focal["decision"]) == ("near-still", "held at prior")
    assert consistent_share(graph, solution.state) > CONSISTENT_SHARE
    assert [flag for flag in solution.flags if "there are no masks" in flag]


@pytest.mark.parametrize(("T", "noise_px", "decision"), [(4, 0.1, "weakly observed"), (3, 0.3, "held at prior")])
def test_a_short_path_does_not_decide_the_focal_length(T: int, noise_px: float, decision: str) -> None:
    scene = make_scene(T=T)
    solution = estimate(Problem(observe(scene, noise_px=noise_px), masked=True), OPTIONS)
    assert (solution.camera, solution.focal["decision"]) == ("moving", decision)
    assert [flag for flag in solution.flags if f"focal length {decision}" in flag]
    held = solution.state.focal_px == pytest.approx(1.1 * 96)
    assert held == (decision == "held at prior")


def test_the_predicted_focal_error_covers_errors_that_neighbouring_matches_share() -> None:
    """Flow errs alike over many pixels and all edges of a frame: as independent errors they would average out."""
    scene, ratios = make_scene(T=6), []
    start = true_state(scene, observe(scene))
    for seed in range(4):
        graph, rng = observe(scene), np.random.default_rng(seed)
        noise = rng.standard_normal((6, graph.rows, graph.columns, 2)).astype(np.float32)
        smooth = np.stack([cv2.GaussianBlur(frame, (0, 0), 3) for frame in noise])
        shared = (0.1 * smooth / smooth.std()).reshape(6, -1, 2)[graph.source]
        graph = replace(graph, matches=graph.matches + shared)
        prior = FocalPrior(scene.focal_px, 1e3)
        found, _ = dba.solve(graph, start, (Level(1.0, 15),), Unknowns(focal=True), prior, "test")
        ratios.append(np.log(found.focal_px / scene.focal_px) / focal_sigma(graph, found))
    assert 0.1 < np.sqrt(np.mean(np.square(ratios))) < 2


def test_measured_depth_is_true_and_its_variance_covers_the_error() -> None:
    scene = make_scene(size=(96, 160), disc_radius=0.6)
    graph, fine = observe(scene, noise_px=0.2), observe(scene, stride=2, noise_px=0.2)
    state = true_state(scene, graph)
    static = static_areas(scene.dynamic, fine.width, fine.height)
    maps = depth_maps(fine, graph, dba.normalise(state), static, observable=True)
    truth = fine.resample(1 / scene.depth, 1).reshape(maps.inverse_depth.shape) / np.median(state.inverse_depth)
    known = ~maps.filled
    error = np.abs(maps.inverse_depth - truth)[known]
    assert np.median(error / truth[known]) < 0.05
    assert np.mean(error < 3 * np.sqrt(maps.variance[known])) > 0.95
    dynamic = np.stack(
        [cv2.resize(frame.astype(np.float32), (80, 48), interpolation=cv2.INTER_AREA) for frame in scene.dynamic]
    )
    assert maps.filled[dynamic > 0.9].all()
    assert (maps.variance[maps.filled] == 1.0).all()


def test_depth_measured_block_by_block_is_that_of_all_frames_at_once() -> None:
    scene = make_scene(T=7, size=(48, 64), zoom=np.linspace(1, 1.2, 7))
    graph = observe(scene, noise_px=0.2)
    state = dba.normalise(replace(true_state(scene, graph), zoom=scene.zoom))
    static = static_areas(scene.dynamic, graph.width, graph.height)
    at_once = depth_maps(graph, graph, state, static, observable=True)
    parts = []
    for frames in ((0, 3), (3, 6), (6, 7)):
        edges = slice(graph.pointer[frames[0]], graph.pointer[frames[1]])
        of_edges = {name: getattr(graph, name)[edges] for name in ("source", "target", "matches", "weights")}
        pointer = np.searchsorted(of_edges["source"], np.arange(8))
        parts.append(depth_maps(replace(graph, **of_edges, pointer=pointer), graph, state, static, True, frames))
    for found, expected in zip(vars(joined(parts)).values(), vars(at_once).values(), strict=True):
        assert (found == expected).all()


def test_masks_from_flow_alone_do_not_free_an_unusual_focal_length() -> None:
    scene = make_scene(size=(96, 160), focal=1.9)
    graph = observe(scene)
    first = estimate(Problem(graph, masked=True), OPTIONS)
    assert first.focal["decision"] == "held at prior"
    previous = PoseGuess(scene.cam_from_world, scene.focal_px)
    later = estimate(Problem(graph, masked=True, previous=previous), OPTIONS)
    assert later.state.focal_px == pytest.approx(scene.focal_px, rel=0.05)
