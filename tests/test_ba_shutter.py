"""A rolling shutter: found where held-out pixels call for it, taken out of the matches, and absent elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rolled import FOCAL, hand, observe_rolled
from synthetic import make_scene, observe, trajectory_error

from stages.ba import dba, diagnostics, held_out, shutter
from stages.ba.estimate import estimate
from stages.ba.graph import MIN_WEIGHT, thin_graph
from stages.ba.options import BAOptions
from stages.ba.problem import Estimate, Problem
from stages.ba.state import FocalPrior, State, Unknowns
from stages.shared import lie, rolling

OPTIONS = BAOptions(start_focals=(1.05,), zoom="no")
SHAKY = hand(0.02, 0.03)
T = 10


def solve(readout: float, rolling_shutter: str = "auto") -> Estimate:
    graph, _ = observe_rolled(SHAKY, readout)
    return estimate(Problem(graph, masked=True), OPTIONS.model_copy(update={"rolling_shutter": rolling_shutter}))


def test_matches_of_a_rolling_shutter_are_corrected_to_those_of_the_middle_row() -> None:
    """The oracle moves every row with the true path; the correction knows only the poses of the frames."""
    graph, depth = observe_rolled(SHAKY, 0.8, noise_px=0.0)
    state = State(SHAKY(np.arange(T)), graph.resample(1 / depth, 1), FOCAL * graph.width)
    sure = graph.weights > MIN_WEIGHT
    raw, corrected = (dba.errors_px(given, state)[sure] for given in (graph, shutter.correct(graph, state, 0.8)))
    assert np.median(raw) > 0.05
    assert np.median(corrected) < 0.06 * np.median(raw)


def test_rows_are_those_of_the_image_where_pixels_are_not_square() -> None:
    """The same flow as a lens of fy = 2 fx shows it, whose graph has half of every v."""
    graph, depth = observe_rolled(SHAKY, 0.8, noise_px=0.0, T=4)
    state = State(SHAKY(np.arange(4)), graph.resample(1 / depth, 1), FOCAL * graph.width)
    tall = replace(graph, aspect=2.0, height=2 * graph.height - 1)
    assert_allclose(shutter.shifts(tall, state, 0.8), shutter.shifts(graph, state, 0.8), atol=1e-6)


def test_a_camera_moves_as_far_in_a_readout_whether_or_not_frames_were_dropped() -> None:
    """The truth of a phone that dropped two frames: the path at the times of the frames that are left."""
    graph, depth = observe_rolled(SHAKY, 0.8, noise_px=0.0)
    kept = np.array([0, 1, 2, 4, 5, 6, 8, 9])
    ends = np.isin(graph.source, kept) & np.isin(graph.target, kept)
    source, target = (np.searchsorted(kept, side[ends]) for side in (graph.source, graph.target))
    pointer = np.searchsorted(source, np.arange(len(kept) + 1))
    thinned = replace(graph, source=source, target=target, pointer=pointer, matches=graph.matches[ends])
    thinned = replace(thinned, weights=graph.weights[ends], times_s=100 + kept / 24)
    state = State(SHAKY(kept), graph.resample(1 / depth, 1)[kept], FOCAL * graph.width)
    sure = thinned.weights > MIN_WEIGHT
    raw, corrected = (dba.errors_px(given, state)[sure] for given in (thinned, shutter.correct(thinned, state, 0.8)))
    assert np.median(corrected) < 0.1 * np.median(raw)


def test_small_motions_of_rows_are_those_of_the_exponential() -> None:
    rng = np.random.default_rng(1)
    points, d, twists = rng.normal((0, 0, 4), 1, (50, 3)), rng.uniform(0.1, 1, 50), rng.normal(0, 0.01, (50, 6))
    poses = lie.exp_se3(twists)
    exact = np.einsum("nab,nb->na", poses[:, :3, :3], points) + d[:, None] * poses[:, :3, 3]
    assert_allclose(rolling.moved_by(points, d, twists), exact, atol=1e-4)


def test_the_correction_by_the_readout_grows_as_finite_differences_of_the_path_say() -> None:
    """Its derivative at no readout: the speed of the image at either end of a match, times its row."""
    graph = observe(make_scene(T=5), stride=8)
    state = State(SHAKY(np.arange(5.0)), np.full((5, len(graph.pixels)), 0.2), 80.0)
    path, step = rolling.path_of(state.cam_from_world, np.arange(5.0)), 1e-4
    derivative = (shutter.shifts(graph, state, step) - shutter.shifts(graph, state, -step)) / (2 * step)

    def projected(e: int, source_step: float, target_step: float) -> np.ndarray:
        """Pixels [P, 2] with the cameras of both ends moved along the path, in frames."""
        i, j = graph.source[e], graph.target[e]
        ends = (i, source_step), (j, target_step)
        source, target = (lie.exp_se3(path(k + by) - path(k)) @ state.cam_from_world[k] for k, by in ends)
        points = np.insert((graph.pixels - graph.centre) / 80.0, [2, 2], [1.0, 0.2], axis=1)
        points = points @ (target @ lie.inverse(source)).T
        return np.asarray(80.0 * points[:, :2] / points[:, 2:3])

    for e in (0, 5):
        here = shutter.row_times(graph, graph.pixels[:, 1])[:, None]
        there = shutter.row_times(graph, graph.matches[e, :, 1])[:, None]
        of_source, of_target = (projected(e, *ends) - projected(e, *-np.array(ends)) for ends in ((1e-4, 0), (0, 1e-4)))
        assert_allclose(derivative[e], (here * of_source + there * of_target) / 2e-4, atol=0.02)


@pytest.mark.parametrize("readout", [0.6, -0.6])
def test_a_rolling_shutter_is_found_with_its_readout_and_better_poses(readout: float) -> None:
    solution, truth = solve(readout), SHAKY(np.arange(T))
    assert solution.rolling.decision == "rolling"
    assert solution.rolling.readout == pytest.approx(readout, abs=0.05)
    assert trajectory_error(solution.state.cam_from_world, truth) < 2.5e-3
    assert any("rolling shutter" in flag for flag in solution.flags)
    if readout > 0:
        at_once = solve(readout, "no")
        assert trajectory_error(at_once.state.cam_from_world, truth) > 1e-2


@pytest.mark.parametrize(("turn", "drift_px"), [(0.02, 3), (0.03, 10)])
def test_what_moves_in_a_few_tiles_hides_no_short_readout(turn: float, drift_px: float) -> None:
    """The search goes on: on a usual tile even the first readouts save something, in the sum they do not."""
    path = hand(turn, 0.03)
    graph, depth = observe_rolled(path, 0.15)
    state = State(path(np.arange(T)), graph.resample(1 / depth, 1), FOCAL * graph.width)
    moves = np.abs(graph.pixels - graph.centre - 10).max(axis=1) < 0.2 * graph.width
    drift = np.random.default_rng(4).normal(0, drift_px, (len(graph.source), 1, 2)) * moves[:, None]
    mixed, prior = replace(graph, matches=graph.matches + drift.astype(np.float32)), FocalPrior(FOCAL * graph.width)
    found = shutter.weigh(mixed, state, Unknowns(True, True), prior, assumed=False)
    assert found.decision == "rolling"
    assert found.readout == pytest.approx(0.15, abs=0.05)


def test_what_moves_in_a_few_tiles_hardly_lessens_what_a_rolling_shutter_saves() -> None:
    """Its flow, which nobody has masked, costs much with the shutter and without: a usual tile counts, not the sum."""
    graph, depth = observe_rolled(SHAKY, 0.25)
    state = State(SHAKY(np.arange(T)), graph.resample(1 / depth, 1), FOCAL * graph.width)
    moves = np.abs(graph.pixels - graph.centre - 10).max(axis=1) < 0.2 * graph.width
    drift = np.random.default_rng(4).normal(0, 3, (len(graph.source), 1, 2)) * moves[:, None]
    mixed, prior = replace(graph, matches=graph.matches + drift.astype(np.float32)), FocalPrior(FOCAL * graph.width)
    found = [shutter.weigh(of, state, Unknowns(True, True), prior, assumed=False) for of in (graph, mixed)]
    assert [of.decision for of in found] == ["rolling", "rolling"]
    assert found[1].readout == pytest.approx(found[0].readout, abs=0.1)
    assert found[1].gain > 0.7 * found[0].gain


@pytest.mark.parametrize("readout", [0.85, -0.5, -0.9])
def test_long_readouts_are_found_from_either_side(readout: float) -> None:
    """From a path that took all rows as exposed at once; the first readout that is tried may be on the wrong side."""
    path = hand(0.04, 0.03)
    graph, depth = observe_rolled(path, readout)
    state = State(path(np.arange(T)), graph.resample(1 / depth, 1), FOCAL * graph.width)
    unknowns, prior = Unknowns(True, True), FocalPrior(FOCAL * graph.width)
    begun, _ = dba.solve(graph, state, held_out.SCHEDULE, unknowns, prior, "as if at once")
    found = shutter.weigh(graph, begun, unknowns, prior, assumed=False)
    assert found.decision == "rolling"
    assert found.readout == pytest.approx(readout, abs=0.05)


def test_the_next_readout_lies_beyond_the_best_or_a_step_from_it_within_its_neighbours() -> None:
    bowl = {at: (at + 0.4) ** 2 for at in (0.0, 0.3, -0.3)}
    assert shutter._next({0.0: 1.0, 0.3: 2.0}, 0.1) == -0.3
    assert shutter._next({0.0: 2.0, 0.3: 1.0}, 0.1) == 0.6
    assert shutter._next(bowl, 0.1) == -0.6
    assert shutter._next(bowl | {-0.6: 0.04}, -0.1) == pytest.approx(-0.4)
    assert shutter._next(bowl | {-0.6: 0.04}, -0.5) == -0.6
    assert shutter._next({0.0: 4.0, 0.3: 3.0, 0.6: 2.0, 1.0: 1.0}, 0.2) == 1.0
    assert shutter._next({0.0: 4.0, 0.3: 3.0, 0.6: 2.0, 1.0: 1.0}, -0.1) == pytest.approx(0.9)


def test_a_rolling_shutter_is_no_zoom() -> None:
    """Without the shutter one focal length per frame saves a fifth of the cost, and takes some of the readout along."""
    path = hand(0.03, 0.03)
    graph, _ = observe_rolled(path, 0.8, noise_px=0.02, T=16)
    solution = estimate(Problem(graph, masked=True), OPTIONS.model_copy(update={"zoom": "auto"}))
    assert solution.zoom.decision == "constant"
    assert solution.zoom.gain == pytest.approx(0, abs=0.02)
    assert solution.state.zoom is None
    assert solution.rolling.readout == pytest.approx(0.8, abs=0.05)


@pytest.mark.parametrize(("readout", "stops"), [(0.0, True), (0.2, False)])
def test_the_search_stops_where_no_readout_saves_anything(
    readout: float, stops: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After two readouts beside none; a small one is looked for on."""
    found: list[int] = []

    def kept(*args: object) -> tuple[dict[float, shutter.Fit], float]:
        result = search(*args)
        found.append(len(result[0]))
        return result

    search = shutter._search
    monkeypatch.setattr(shutter, "_search", kept)
    assert (solve(readout).rolling.decision == "global") == stops
    assert (found[-1] <= 3) == stops


def test_without_one_the_solution_is_that_of_a_global_shutter_to_the_bit() -> None:
    tested, off = solve(0.0), solve(0.0, "no")
    assert (tested.rolling.decision, off.rolling.decision) == ("global", "not tested")
    assert_allclose(tested.state.cam_from_world, off.state.cam_from_world, rtol=0, atol=0)
    assert tested.flags == off.flags


def test_a_shutter_that_is_asked_for_of_a_camera_that_hardly_moves_is_not_followed_and_said() -> None:
    """Its readout would be that of the noise: 0.2 of the frame interval here.

    The search for it stops early, where its predicted error, 0.25, is still beyond what is observable.
    """
    graph, _ = observe_rolled(hand(0.0005, 0.0005, steady=(0.0,) * 6), 0.0)
    off, asked = (
        estimate(Problem(graph, masked=True), OPTIONS.model_copy(update={"rolling_shutter": word}))
        for word in ("no", "yes")
    )
    assert off.camera == "near-still"
    assert asked.rolling.decision == "not observable"
    assert_allclose(asked.state.cam_from_world, off.state.cam_from_world, rtol=0, atol=0)
    assert any("`rolling_shutter: yes` is not followed: the camera hardly moves" in flag for flag in asked.flags)
    assert not any("not followed" in flag for flag in off.flags)


@pytest.mark.parametrize(("gain", "readout_sigma", "told"), [(0.4, 0.2, 1), (0.4, 8.0, 0), (0.02, 0.2, 0)])
def test_a_shutter_that_may_roll_is_told_where_its_readout_is_known_to_itself(
    gain: float, readout_sigma: float, told: int
) -> None:
    evidence = shutter.Evidence("not observable", "why", gain, 0.01, readout=0.5, readout_sigma=readout_sigma)
    assert len(diagnostics.of_shutter(evidence)) == told


def test_depths_are_carried_to_other_pixels() -> None:
    graph, depth = observe_rolled(SHAKY, 0.0, T=3)
    state = State(SHAKY(np.arange(3)), graph.resample(1 / depth, 1), FOCAL * graph.width)
    coarse = thin_graph(graph, 3)
    assert_allclose(shutter.resampled(state, graph, coarse).inverse_depth, coarse.resample(1 / depth, 1), rtol=1e-6)


@pytest.mark.parametrize(
    ("numbers", "decision"),
    [
        ((0.2, 0.02, 0.5, 0.05), "rolling"),
        ((0.2, 0.02, -0.5, 0.05), "rolling"),
        ((0.01, 0.001, 0.5, 0.05), "global"),
        ((0.2, 0.1, 0.5, 0.05), "global"),
        ((0.2, 0.02, 0.1, 0.05), "global"),
        ((0.2, 0.02, 0.9, 0.2), "not observable"),
    ],
    ids=["clear", "from the bottom", "too little gain", "gain by chance", "no larger than its error", "blind"],
)
def test_the_decision_follows_gain_and_readout_and_their_errors(numbers: tuple[float, ...], decision: str) -> None:
    assert shutter.judge(*numbers)[0] == decision
