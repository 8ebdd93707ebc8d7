"""Hard cases of a changing focal length: what a dolly, a flat scene or a turning camera could be mistaken for."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from synthetic import PLANE, camera_path, make_scene, observe, rotation_error_deg, trajectory_error

from stages.ba import classify, cuts, initialise, zoom
from stages.ba.estimate import estimate
from stages.ba.guesses import PoseGuess
from stages.ba.options import BAOptions
from stages.ba.problem import Estimate, Problem
from stages.ba.state import FocalPrior, State
from stages.ba.turning import estimate_turning_zoom
from stages.shared import lie

OPTIONS = BAOptions(start_focals=(1.05,))
T = 10
RAMP = np.exp(np.log(1.3) * (1 - np.cos(np.linspace(0, np.pi, T))) / 2)
FACING = (((0.0, 0.0, 1.0), 4.0),)
"""A plane across the optical axis."""


def solve(path: np.ndarray, zoom: np.ndarray | None = None, **scene: object) -> tuple[Estimate, np.ndarray]:
    """The solution of a scene with noise, and its true focal lengths [T]."""
    room = make_scene(T=T, size=(96, 160), path=path, zoom=zoom, **scene)  # type: ignore[arg-type]
    solution = estimate(Problem(observe(room, noise_px=0.1), masked=True), OPTIONS)
    return solution, room.focal_px * (np.ones(T) if zoom is None else zoom)


def dolly(length: float = 1.5) -> np.ndarray:
    """Poses [T, 4, 4] of a camera that moves forward along its axis."""
    return lie.exp_se3(np.outer(np.linspace(0, length, T), [0, 0, -1, 0, 0, 0]))


def test_a_dolly_along_the_axis_is_no_zoom() -> None:
    solution, _ = solve(dolly())
    assert solution.zoom.decision != "changing"
    assert trajectory_error(solution.state.cam_from_world, dolly()) < 2e-3


@pytest.mark.parametrize("begin", ["anew", "at the truth"])
def test_a_long_lens_that_travels_is_no_zoom(begin: str) -> None:
    room = make_scene(T=T, size=(96, 160), focal=3.0)
    before = PoseGuess(room.cam_from_world, room.focal_px) if begin == "at the truth" else None
    solution = estimate(Problem(observe(room, noise_px=0.1), masked=True, previous=before), OPTIONS)
    assert solution.zoom.decision != "changing"
    assert solution.state.zoom is None


def test_what_a_better_path_saves_is_not_taken_for_the_saving_of_a_zoom() -> None:
    """The cameras at one focal length stand in a local minimum, out of which the search for a zoom leads."""
    room = make_scene(T=T, size=(96, 160))
    graph = observe(room, noise_px=0.1)
    wrong = room.cam_from_world.copy()
    wrong[:, :3, 3] *= [-1, 1, -1]
    stuck, found = (initialise.initial_state(graph, path, room.focal_px, 1.0) for path in (wrong, room.cam_from_world))
    evidence, _ = zoom.weigh(graph, stuck, lambda: [replace(found, zoom=np.ones(T))], FocalPrior(1.1 * 160))
    assert evidence.decision == "constant"
    assert evidence.gain is not None
    assert evidence.gain < 0.01


@pytest.mark.parametrize(
    ("sigma", "assumed", "is_searched"), [(0.3, False, True), (0.4, False, False), (0.4, True, True)]
)
def test_a_change_that_is_far_from_observable_is_not_searched(
    sigma: float, assumed: bool, is_searched: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though there is a suspicion; unless its cameras are wanted all the same."""
    room = make_scene(T=T, size=(96, 160), zoom=RAMP)
    fixed = initialise.initial_state(observe(room), room.cam_from_world, room.focal_px, 1.0)
    monkeypatch.setattr(zoom, "_change_sigma", lambda *_: sigma)
    searched: list[bool] = []

    def search() -> list[State]:
        searched.append(True)
        return [fixed]

    evidence, _ = zoom.weigh(observe(room), fixed, search, FocalPrior(1.1 * 160), assumed=assumed)
    assert (evidence.decision, bool(searched)) == ("not observable", is_searched)


def test_a_zoom_is_found_from_cameras_whose_one_focal_length_makes_up_for_it() -> None:
    """A lens of four image widths on another path explains much of a zoom. What is searched there alone stays there."""
    curve = RAMP ** (np.log(1.5) / np.log(1.3))
    room = make_scene(T=T, size=(96, 160), zoom=curve)
    before = PoseGuess(room.cam_from_world, 4.0 * 160)
    solution = estimate(Problem(observe(room, noise_px=0.1), masked=True, previous=before), OPTIONS)
    assert solution.zoom.decision == "changing"
    assert_allclose(solution.state.focals_px, room.focal_px * curve, rtol=0.02)
    assert trajectory_error(solution.state.cam_from_world, room.cam_from_world) < 5e-3


def test_a_zoom_along_with_a_dolly_on_the_axis_is_not_observable_and_says_so() -> None:
    """Focal lengths s_k and distances t_k show what 1 / s_k - b t_k / s_k and other depths show, for every b."""
    solution, _ = solve(dolly(), 1 / RAMP)
    assert solution.zoom.decision == "not observable"
    assert solution.state.zoom is None
    assert any("may change" in flag for flag in solution.flags)


@pytest.mark.parametrize("zoom", [None, RAMP], ids=["dolly", "zoom"])
def test_before_a_plane_across_the_axis_dolly_and_zoom_are_the_same_and_the_focal_length_is_held(
    zoom: np.ndarray | None,
) -> None:
    path = dolly() if zoom is None else np.tile(np.eye(4), (T, 1, 1))
    solution, _ = solve(path, zoom, planes=FACING)
    assert solution.zoom.decision in ("not observable", "constant")
    assert solution.state.zoom is None
    assert any("may change" in flag for flag in solution.flags)


def test_a_zoom_before_a_plane_is_not_observable() -> None:
    solution, _ = solve(camera_path(T, "curve"), RAMP, planes=PLANE)
    assert solution.zoom.decision == "not observable"
    assert any("focal length" in flag for flag in solution.flags)


def test_a_camera_that_turns_and_zooms_has_its_turns_and_focal_curve() -> None:
    path = camera_path(T, "rotate")
    solution, focals_px = solve(path, RAMP)
    assert (solution.camera, solution.zoom.decision) == ("rotating", "changing")
    assert_allclose(solution.state.focals_px, focals_px, rtol=0.02)
    assert rotation_error_deg(solution.state.cam_from_world, path) < 0.05


def test_a_camera_that_follows_something_before_a_wall_does_not_zoom() -> None:
    """Turns and focal lengths leave .27 px of the flow, little enough for a camera that turns; a path leaves .01."""
    path = lie.exp_se3(np.arange(T)[:, None] * np.array([0.08, 0, 0, 0, 0.03, 0]))
    room = make_scene(T=T, size=(96, 160), path=path, planes=(((0.5, -0.05, 1.0), 6.0),))
    problem = Problem(observe(room, noise_px=0.02), masked=True)
    solution = estimate(problem, OPTIONS)
    assert solution.camera == "moving"
    assert solution.state.zoom is None
    turning = estimate_turning_zoom(problem, classify.measure(problem.graph, None, 0), FocalPrior(1.1 * 160))
    assert turning.zoom.decision == "changing"  # what the flow alone would say


@pytest.mark.parametrize("motion", ["rotate", "still", "drift"])
def test_a_camera_that_turns_or_hardly_moves_does_not_zoom(motion: str) -> None:
    solution, _ = solve(camera_path(T, motion))
    assert solution.zoom.decision != "changing"
    assert solution.state.zoom is None


@pytest.mark.parametrize("zoom", [None, RAMP], ids=["one focal length", "zoom"])
def test_frames_at_the_end_without_matches_do_not_hide_the_decision(zoom: np.ndarray | None) -> None:
    """Their focal length is what the prior extrapolates; its error says nothing about those of the other frames."""
    room = make_scene(T=T, size=(96, 160), zoom=zoom)
    graph = observe(room, noise_px=0.2)
    blind = np.isin(graph.source, (7, 8, 9)) | np.isin(graph.target, (7, 8, 9))
    graph = replace(graph, weights=np.where(blind[:, None], 0, graph.weights).astype(np.float32))
    solution = estimate(Problem(graph, masked=True), OPTIONS)
    assert solution.zoom.decision == ("constant" if zoom is None else "changing")
    assert solution.zoom.change_sigma is not None
    assert solution.zoom.change_sigma < 0.06
    if zoom is not None:
        curve = solution.state.focals_px[:7] / solution.state.focals_px[0]
        assert_allclose(curve, zoom[:7] / zoom[0], rtol=0.02)


def test_a_zoom_that_the_options_assume_is_reported_as_such_where_it_is_not_observable() -> None:
    room = make_scene(T=T, size=(96, 160), path=dolly(), planes=FACING)
    solution = estimate(Problem(observe(room, noise_px=0.1), masked=True), OPTIONS.model_copy(update={"zoom": "yes"}))
    assert solution.state.zoom is not None
    assert solution.zoom.decision == "changing", "focal lengths that differ are not reported as one"
    assert solution.zoom.reason.startswith("as the options say")


def test_the_zoom_of_a_shot_within_a_clip_is_put_back_on_its_frames() -> None:
    """Also with the cameras of a round before, which cover the whole clip."""
    room = make_scene(T=T, size=(96, 160), zoom=RAMP)
    shot = (np.arange(T) > 0) & (np.arange(T) < 8)
    graph = cuts.isolate(observe(room, noise_px=0.1), shot)
    before = PoseGuess(room.cam_from_world, room.focal_px, RAMP)
    solution = cuts.estimate_shot(Problem(graph, masked=True, previous=before), shot, OPTIONS)
    assert solution.zoom.decision == "changing"
    focals_px = solution.state.focals_px
    assert_allclose(focals_px[shot], (room.focal_px * RAMP)[shot], rtol=0.02)
    assert_allclose(focals_px[[0, 8, 9]], focals_px[[1, 7, 7]])
