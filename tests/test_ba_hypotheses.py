"""Guesses at the camera's path: planes, wrong masks, and objects that could be taken for the scene."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from synthetic import PLANE, make_scene, observe, trajectory_error

from stages.ba import dba, path, planar, start
from stages.ba.classify import longest_step, measure
from stages.ba.estimate import estimate
from stages.ba.graph import MIN_WEIGHT, build_graph, thin_graph
from stages.ba.guesses import Observed
from stages.ba.initialise import Candidate, adjust, initial_state, pair_chain
from stages.ba.options import BAOptions
from stages.ba.problem import Problem
from stages.ba.refinement import FINE_PX, _adjust_twice
from stages.ba.start import Start
from stages.ba.state import FocalPrior, Level, State, Unknowns
from stages.ba.weights import favour_distance, mask_graph

OPTIONS = BAOptions()


def test_an_upright_frame_begins_with_the_focal_lengths_of_one_held_across(monkeypatch: pytest.MonkeyPatch) -> None:
    begun, find_start = [], path.find_start

    def told(observed: Observed) -> Start:
        begun.append((observed.focals_px, observed.prior.focal_px))
        return find_start(observed)

    monkeypatch.setattr(path, "find_start", told)
    for size in ((96, 160), (160, 96)):
        scene = make_scene(size=size, focal=0.9 * 160 / size[1])
        found = estimate(Problem(observe(scene), masked=True), OPTIONS)
        assert found.state.focal_px == pytest.approx(scene.focal_px, rel=0.02)
    assert begun[0] == begun[1] == ([focal * 160 for focal in OPTIONS.start_focals], pytest.approx(1.1 * 160))


@pytest.mark.parametrize(("focal_error", "limit"), [(0.0, 0.01), (0.3, 0.05)])
def test_homographies_of_a_plane_chain_to_the_path_even_with_a_wrong_focal_length(
    focal_error: float, limit: float
) -> None:
    scene = make_scene(size=(96, 160), planes=PLANE)
    steps = planar.homographies(observe(scene, noise_px=0.05))
    poses = planar.chain_planes(steps, scene.focal_px * (1 + focal_error))
    assert trajectory_error(poses, scene.cam_from_world) < limit


def test_a_chain_over_lost_planes_stays_at_rest() -> None:
    assert_allclose(planar.chain_planes([None, None], 100.0), np.tile(np.eye(4), (3, 1, 1)))


def test_a_planar_scene_gives_path_and_focal_length_without_masks() -> None:
    scene = make_scene(size=(96, 160), planes=PLANE)
    solution = estimate(Problem(observe(scene, noise_px=0.05), masked=False), OPTIONS)
    assert solution.statistics["planar"]
    assert trajectory_error(solution.state.cam_from_world, scene.cam_from_world) < 5e-3
    assert solution.state.focal_px == pytest.approx(scene.focal_px, rel=0.06)


def test_an_object_over_half_of_the_image_is_not_taken_for_the_scene() -> None:
    scene = make_scene(size=(96, 160), disc_radius=1.0)
    assert scene.dynamic.mean() > 0.5
    graph = observe(scene, masked=False)
    solution = estimate(Problem(graph, masked=False, known_focal_px=scene.focal_px), OPTIONS)
    assert trajectory_error(solution.state.cam_from_world, scene.cam_from_world) < 0.01
    assert any("two motions" in flag for flag in solution.flags)
    assert solution.static is not None
    agreement = (solution.static > 0.5) == ~scene.dynamic
    assert agreement.mean() > 0.8


def test_masks_over_the_scene_itself_do_not_win() -> None:
    scene = make_scene(size=(96, 160), disc_radius=0.5)
    everything = observe(scene, masked=False)
    inverted = mask_graph(everything, scene.dynamic)
    problem = Problem(inverted, masked=True, known_focal_px=scene.focal_px, unmasked=everything)
    solution = estimate(problem, OPTIONS)
    assert trajectory_error(solution.state.cam_from_world, scene.cam_from_world) < 0.01
    assert solution.flags


def test_pixels_without_sure_matches_say_nothing_of_which_motion_is_the_background() -> None:
    """Around a mover, as in its blur, uncertain matches follow it: counted, it would cover more of the border."""
    scene, blurred = make_scene(size=(96, 160), disc_radius=0.5), make_scene(size=(96, 160), disc_radius=1.2)
    everything, mover = observe(blurred, masked=False), mask_graph(observe(scene, masked=False), scene.dynamic)
    around = mask_graph(everything, blurred.dynamic & ~scene.dynamic).weights > 0
    weights = np.where(around & (mover.weights == 0), MIN_WEIGHT / 2, everything.weights)
    unmasked = replace(everything, weights=weights)
    problem = Problem(mask_graph(unmasked, ~blurred.dynamic), True, scene.focal_px, unmasked=unmasked)
    solution = estimate(problem, OPTIONS)
    assert trajectory_error(solution.state.cam_from_world, scene.cam_from_world) < 1e-4
    assert not any("two motions" in flag for flag in solution.flags)


def test_thinned_observations_are_those_of_wider_cells() -> None:
    scene = make_scene(T=3, size=(48, 72))
    fine, coarse = observe(scene, stride=3), observe(scene, stride=9)
    thin = thin_graph(fine, 3)
    assert_allclose(thin.pixels, coarse.pixels)
    assert_allclose(thin.matches, coarse.matches, atol=1e-6)
    assert (thin.rows, thin.columns, thin.stride) == (coarse.rows, coarse.columns, 9)


def test_chained_pairs_take_the_longest_edges_that_lead_to_the_end() -> None:
    source, target = np.array([(i, j) for i in range(9) for j in range(9) if abs(i - j) in (1, 2, 5)]).T
    flow = np.zeros((len(source), 8, 8, 2), np.float32)
    graph = build_graph(source, target, flow, np.ones(flow.shape[:3], np.float32), 9, 4)
    assert pair_chain(graph, 5) == [(0, 5), (5, 7), (7, 8)]
    assert pair_chain(graph, 1) == [(i, i + 1) for i in range(8)]


def test_frames_too_far_apart_to_match_are_not_chained() -> None:
    graph = observe(make_scene(size=(96, 160)))
    assert longest_step(graph) == 3
    graph.weights[np.abs(graph.target - graph.source) == 3] *= 0.1
    assert longest_step(graph) == 2


def test_a_kernel_as_narrow_as_the_noise_cuts_off_biased_flow() -> None:
    scene = make_scene(size=(96, 160))
    graph = observe(scene, noise_px=0.02)
    biased = graph.pixels[:, 0] < 40
    graph.matches[:, biased, 1] += 0.3
    start = State(scene.cam_from_world, graph.resample(1 / scene.depth, 1), scene.focal_px)
    prior, unknowns = FocalPrior(1.1 * graph.width), Unknowns(focal=True)
    wide = adjust(graph, start, [Level(scale, 15) for scale in FINE_PX], unknowns, prior, "wide").state
    sharp = _adjust_twice(Problem(graph, True), start, unknowns, prior).state
    errors = [trajectory_error(state.cam_from_world, scene.cam_from_world) for state in (wide, sharp)]
    assert errors[1] < 0.5 * errors[0]


def test_errors_that_short_edges_share_give_way_to_distant_frames() -> None:
    """Each edge between neighbours takes the camera as much too far; what distant frames see contradicts it."""
    scene = make_scene(T=6)
    graph = observe(scene, offsets=(1, 5), noise_px=0.02)
    near = np.abs(graph.target - graph.source) == 1
    graph.matches[near, :, 0] += 0.1 * np.sign(graph.target - graph.source)[near, None]
    start = State(scene.cam_from_world, graph.resample(1 / scene.depth, 1), scene.focal_px)
    found = _adjust_twice(Problem(graph, True), start, Unknowns(), FocalPrior(scene.focal_px)).state
    errors = dba.errors_px(graph, found)
    assert np.median(errors[~near][graph.weights[~near] > 0]) < 0.5 * np.median(errors[near])


def test_distant_frames_weigh_more_and_all_together_the_same() -> None:
    graph = observe(make_scene(T=5, size=(48, 72)))
    favoured = favour_distance(graph)
    far, near = (np.abs(graph.target - graph.source) == step for step in (3, 1))
    factor = favoured.weights.max(axis=1) / graph.weights.max(axis=1)
    assert_allclose(factor[far], 3 * factor[near].mean(), rtol=1e-5)
    assert factor.mean() == pytest.approx(1.0, rel=1e-5)


def test_the_limit_of_iterations_bounds_every_level() -> None:
    scene = make_scene(T=5, size=(64, 96))
    graph = observe(scene, stride=8)
    steps = estimate(Problem(graph, True, iterations=2), BAOptions()).steps
    refined = [step.phase for step in steps if step.phase.startswith("refinement")]
    assert 0 < refined.count("refinement") <= 2 * len(FINE_PX)
    assert 0 < refined.count("refinement, sharp") <= 2


@pytest.mark.parametrize(("roughness", "ignored"), [(0.03, False), (0.5, True)])
def test_masks_are_ignored_only_where_they_leave_a_rough_path(
    roughness: float, ignored: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Good masks were given up for a path that was smoother still, and wrong: that of a scene in which half moves."""
    scene = make_scene(disc_radius=0.5)
    masked, unmasked = observe(scene, stride=8), observe(scene, stride=8, masked=False)
    state = initial_state(unmasked, scene.cam_from_world, scene.focal_px)
    with_masks = Candidate("with masks", state, 1.0, roughness, [])
    without = Candidate("without", state, 1.0, roughness / 4, [])
    monkeypatch.setattr(start, "guess", lambda _, graph: [with_masks if graph.weights.sum() < most else without])
    most = thin_graph(unmasked, 1).weights.sum()
    statistics = measure(masked, scene.focal_px, 0)
    observed = Observed(masked, unmasked, None, [scene.focal_px], statistics, FocalPrior(scene.focal_px), 0)
    found = start.find_start(observed)
    assert found.candidate is (without if ignored else with_masks)
    assert any("masks ignored" in flag for flag in found.flags) == ignored
