"""A focal length that changes over the frames: estimated where held-out pixels call for it, and absent elsewhere."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats
from synthetic import make_scene, observe, trajectory_error

from stages.ba import dba, held_out, proposal, twoview, zoom
from stages.ba.estimate import estimate
from stages.ba.graph import FlowGraph
from stages.ba.options import BAOptions
from stages.ba.problem import Problem
from stages.ba.solving import _previous
from stages.ba.state import FocalPrior, Level, State, Unknowns
from stages.ba.uncertainty import solution_covariance
from stages.shared.cameras import intrinsics, make_cameras, write_cameras

OPTIONS = BAOptions(start_focals=(1.05,))
NOISE_PX = 0.1


def ramp(T: int, strength: float) -> np.ndarray:
    """Focal lengths [T] over that of the first frame, which grow smoothly by the share `strength`."""
    return np.asarray(np.exp(np.log1p(strength) * (1 - np.cos(np.linspace(0, np.pi, T))) / 2))


def test_a_zooming_camera_is_found_with_its_path_and_focal_curve() -> None:
    curve = ramp(10, 0.3)
    scene = make_scene(T=10, size=(96, 160), zoom=curve)
    graph = observe(scene, noise_px=NOISE_PX)
    solution = estimate(Problem(graph, masked=True), OPTIONS)
    assert solution.zoom.decision == "changing"
    assert solution.zoom.change == pytest.approx(np.log(1.3), rel=0.05)
    assert_allclose(solution.state.focals_px, scene.focal_px * curve, rtol=0.01)
    assert trajectory_error(solution.state.cam_from_world, scene.cam_from_world) < 2e-3
    held = estimate(Problem(graph, masked=True), OPTIONS.model_copy(update={"zoom": "no"}))
    assert trajectory_error(held.state.cam_from_world, scene.cam_from_world) > 0.01, (
        "one focal length does not explain it"
    )


def test_without_zoom_the_solution_is_that_of_one_focal_length_to_the_bit() -> None:
    graph = observe(make_scene(T=10, size=(96, 160)), noise_px=NOISE_PX)
    tested = estimate(Problem(graph, masked=True), OPTIONS)
    off = estimate(Problem(graph, masked=True), OPTIONS.model_copy(update={"zoom": "no"}))
    assert (tested.zoom.decision, off.zoom.decision) == ("constant", "not tested")
    assert tested.state.zoom is None
    assert_allclose(tested.state.cam_from_world, off.state.cam_from_world, rtol=0, atol=0)
    assert tested.state.focal_px == off.state.focal_px


def test_zoom_can_be_set_where_it_is_not_found() -> None:
    scene = make_scene(T=10, size=(96, 160))
    solution = estimate(Problem(observe(scene), masked=True), OPTIONS.model_copy(update={"zoom": "yes"}))
    assert solution.zoom.decision == "changing"
    assert solution.zoom.reason.startswith("as the options say")
    assert_allclose(solution.state.focals_px, scene.focal_px, rtol=0.01)
    (told,) = solution.flags
    assert told.startswith("a focal length per frame, as the options say; it saves -")


@pytest.mark.parametrize(("motion", "why"), [("still", "the camera hardly moves"), ("rotate", "the camera only turns")])
def test_a_zoom_that_is_asked_for_of_a_camera_that_does_not_move_is_not_followed_and_said(
    motion: str, why: str
) -> None:
    graph = observe(make_scene(T=10, size=(96, 160), motion=motion), noise_px=NOISE_PX)
    auto, asked = (
        estimate(Problem(graph, masked=True), OPTIONS.model_copy(update={"zoom": word})) for word in ("auto", "yes")
    )
    assert asked.state.zoom is None
    assert [flag for flag in asked.flags if flag not in auto.flags] == [
        flag for flag in asked.flags if f"`zoom: yes` is not followed: {why}" in flag
    ]
    assert len(asked.flags) == len(auto.flags) + 1


def test_epipolar_geometry_of_a_pair_gives_the_ratio_of_its_focal_lengths() -> None:
    scene = make_scene(T=2, size=(96, 160), zoom=np.array([1.0, 1.04]))
    graph = observe(scene, offsets=(1,), noise_px=0.03)
    rays = twoview.pair_rays(graph, 0, 1, scene.focal_px)
    motion = twoview.estimate_motion(*rays, scene.focal_px, 0.5, 0)
    assert motion is not None
    assert twoview.zoom_ratio(motion, *rays, 0.5, scene.focal_px) == pytest.approx(1.04, abs=0.002)


def compared(graph: FlowGraph, *errors_px: np.ndarray) -> tuple[held_out.Fit, held_out.Fit]:
    """Simpler and richer cameras that leave these errors [P]."""
    state = State(np.tile(np.eye(4), (graph.T, 1, 1)), np.ones((graph.T, len(graph.pixels))), 1.0)
    shape = graph.weights.shape
    simple, rich = (held_out.Fit(state, 0.0, np.broadcast_to(of, shape).astype(np.float32)) for of in errors_px)
    return simple, rich


def test_a_usual_tile_is_not_that_of_a_mover_which_fits_the_wrong_cameras_alone() -> None:
    graph = observe(make_scene(size=(96, 144)))
    x, y = graph.pixels.T
    mover = (x > 50) & (x < 118) & (y > 24) & (y < 72)
    pair = compared(graph, np.where(mover, 0.1, 0.3), np.where(mover, 3.0, 0.2))
    assert held_out.gain(graph, pair)[0] < -0.1
    gain, sigma = held_out.usual_gain(graph, pair)
    # The robust scale is twice the median residual, 0.4 px: (0.3 / 0.4)^2 / (1 + (0.3 / 0.4)^2) is 0.36, of 0.2 px 0.2.
    assert gain == pytest.approx(1 - 0.2 / 0.36, abs=1e-3)
    assert sigma < 0.02


def test_a_usual_gain_is_that_of_the_tiles_that_were_asked_for() -> None:
    graph = observe(make_scene(size=(96, 144)))
    fitted = held_out.halves(graph)[0].weights.any(axis=0)
    pair = compared(graph, np.array(0.3), np.where(fitted, 0.1, 0.3))
    assert held_out.usual_gain(graph, pair)[0] == pytest.approx(0, abs=1e-6)
    assert held_out.usual_gain(graph, pair, fitted=True)[0] > 0.5


@pytest.mark.parametrize("n", [4, 7, 24])
def test_a_trimmed_mean_and_its_error_are_those_of_scipy(n: int) -> None:
    values = np.random.default_rng(n).normal(size=n) ** 3
    share = held_out.TRIMMED
    expected = stats.trim_mean(values, share), stats.mstats.trimmed_stde(values, limits=(share, share))
    assert_allclose(held_out.trimmed_mean(values), expected)


def test_from_a_handful_of_tiles_no_gain_is_told() -> None:
    graph = observe(make_scene(size=(96, 144)))
    corner = (graph.pixels[:, 0] < 40) & (graph.pixels[:, 1] < 40)
    graph = replace(graph, weights=graph.weights * corner)
    assert held_out.usual_gain(graph, compared(graph, np.array(0.3), np.array(0.1))) == (0.0, 1.0)


def with_a_blind_frame(curve: np.ndarray) -> tuple[FlowGraph, State]:
    """Eight frames of a lens that zooms, without matches of the fifth, and their true state."""
    scene = make_scene(size=(64, 96), zoom=curve)
    graph = observe(scene)
    blind = (graph.source == 4) | (graph.target == 4)
    graph = replace(graph, weights=np.where(blind[:, None], 0, graph.weights).astype(np.float32))
    return graph, State(scene.cam_from_world, graph.resample(1 / scene.depth, 1), scene.focal_px, curve)


def test_frames_without_matches_take_a_focal_length_between_those_of_their_neighbours() -> None:
    curve = ramp(8, 0.2)
    graph, true = with_a_blind_frame(curve)
    unknowns, prior = Unknowns(focal=True, zoom=True), FocalPrior(true.focal_px)
    start = replace(true, zoom=np.ones(8))
    found, _ = dba.solve(graph, start, (Level(2.0, 30), Level(0.5, 40)), unknowns, prior, "test")
    assert_allclose(found.focals_px / found.focals_px[0], curve, rtol=0.005)


def test_a_frame_without_matches_has_a_focal_length_with_the_error_of_the_prior() -> None:
    graph, state = with_a_blind_frame(ramp(8, 0.2))
    covariance = solution_covariance(graph, dba.normalise(state), zoom.PER_FRAME)
    sigma = np.sqrt(np.diagonal(covariance.of(np.eye(7 * graph.T)[6 * graph.T :])))
    assert sigma[3] < sigma[4] < 1.2 * sigma[3]


def test_without_matches_the_prior_alone_makes_the_curve_straight_about_its_centre() -> None:
    graph, state = with_a_blind_frame(ramp(8, 0.2))
    graph = replace(graph, weights=np.zeros_like(graph.weights))
    unknowns, prior = Unknowns(focal=True, translation=False, zoom=True), FocalPrior(1.1 * state.focal_px)
    found, _ = proposal.propose(graph, state, 1.0, 0.0, unknowns, prior)
    assert found is not None
    logs = np.log(found.focals_px / prior.focal_px)
    assert_allclose(np.diff(logs, 2), 0, atol=1e-4)
    assert_allclose(logs.mean(), 0, atol=1e-4)


def test_the_next_round_begins_from_the_focal_curve_of_the_one_before(tmp_path: Path) -> None:
    focals_px = 100 * ramp(8, 0.2)
    Ks = intrinsics(focals_px, focals_px, 47.5, 31.5)
    file = tmp_path / "poses.parquet"
    poses = np.tile(np.eye(4), (8, 1, 1))
    write_cameras(file, make_cameras(poses, Ks, np.arange(8)), {})
    guess = _previous(file, 0.5, 96)
    assert guess is not None
    assert guess.zoom is not None
    assert_allclose(guess.focal_px * guess.zoom, focals_px / 2)
    assert guess.focal_px == pytest.approx(np.exp(np.log(focals_px / 2).mean()))


@pytest.mark.parametrize(
    ("numbers", "decision"),
    [
        ((0.2, 0.02, 0.1, 0.01), "changing"),
        ((0.01, 0.001, 0.1, 0.01), "constant"),
        ((0.2, 0.15, 0.1, 0.01), "constant"),
        ((0.14, 0.046, 0.35, 0.077), "constant"),
        ((0.2, 0.02, 0.01, 0.02), "not observable"),
        ((0.2, 0.02, 0.3, 0.2), "not observable"),
    ],
    ids=["clear", "too little gain", "gain by chance", "gain of movers", "no larger than its error", "blind"],
)
def test_the_decision_follows_gain_and_change_and_their_errors(numbers: tuple[float, ...], decision: str) -> None:
    assert zoom.judge(*numbers)[0] == decision


def test_a_change_is_said_as_the_largest_over_the_smallest_focal_length() -> None:
    assert "would change by 30.0 %" in zoom.judge(0.01, 0.001, np.log(1.3), 0.01)[1]
