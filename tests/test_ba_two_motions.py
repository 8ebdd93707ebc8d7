"""A large mover that travels along with the camera, or comes: its motion is told from the world's, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import Scene, make_scene, observe, trajectory_error

from stages.ba import initialise, start, two_motions
from stages.ba.estimate import estimate
from stages.ba.graph import FlowGraph
from stages.ba.options import BAOptions
from stages.ba.problem import Estimate, Problem
from stages.ba.state import FocalPrior, Level, State, Unknowns
from stages.shared import lie

NOISE_PX = 0.05


def beside(radius: float = 0.8, zoom: np.ndarray | None = None) -> Scene:
    """A disc that keeps two thirds of the velocity of the camera, over a third of the view; without a radius, none."""
    return make_scene(T=8, size=(96, 144), disc_radius=radius, velocity=(0.1, -0.06, 0.1), zoom=zoom)


def cameras(graph: FlowGraph, scene: Scene) -> State:
    """Cameras adjusted from the true ones at a longer lens."""
    state = initialise.initial_state(graph, scene.cam_from_world, 1.2 * scene.focal_px, zoom=scene.zoom)
    levels, unknowns = (Level(1.0, 8), Level(0.4, 8)), Unknowns(focal=True, zoom=scene.zoom is not None)
    return initialise.adjust(graph, state, levels, unknowns, FocalPrior(1.1 * graph.width), "").state


def first_round(scene: Scene) -> Estimate:
    """The solution without masks, from one initial focal length."""
    graph = observe(scene, stride=6, masked=False, noise_px=NOISE_PX)
    return estimate(Problem(graph, False), BAOptions(start_focals=(1.05,)))


def test_a_mover_that_travels_along_leaves_path_and_focal_length_right(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = beside()
    found = first_round(scene)
    assert found.state.focal_px == pytest.approx(scene.focal_px, rel=0.02)
    assert trajectory_error(found.state.cam_from_world, scene.cam_from_world) < 1e-3
    assert found.static is not None
    assert found.static[scene.dynamic].mean() < 0.1
    assert any(flag.startswith("two motions") for flag in found.flags)
    monkeypatch.setattr(start.two_motions, "background", lambda *_: None)
    monkeypatch.setattr(start, "EXPLAINED", 0.0)
    without = first_round(scene)
    assert trajectory_error(without.state.cam_from_world, scene.cam_from_world) > 2e-3


@pytest.mark.parametrize("radius", [0.0, 0.4])
def test_cameras_that_are_right_are_kept(radius: float) -> None:
    scene = beside(radius)
    graph = observe(scene, stride=6, masked=False, noise_px=NOISE_PX)
    assert two_motions.background(graph, graph, cameras(graph, scene), FocalPrior(1.1 * graph.width)) is None


def test_good_masks_are_kept_over_what_two_motions_fit() -> None:
    scene = beside()
    plain, masked = (observe(scene, stride=6, masked=with_masks, noise_px=NOISE_PX) for with_masks in (False, True))
    assert two_motions.background(plain, masked, cameras(masked, scene), FocalPrior(1.1 * plain.width)) is None


def test_a_lens_that_zooms_is_no_second_motion() -> None:
    scene = beside(0.0, np.linspace(1, 1.3, 8))
    graph = observe(scene, stride=6, masked=False, noise_px=NOISE_PX)
    assert two_motions.background(graph, graph, cameras(graph, scene), FocalPrior(1.1 * graph.width)) is None


def test_the_background_is_what_lies_along_the_border() -> None:
    scene = beside()
    graph = observe(scene, stride=6, masked=False, noise_px=NOISE_PX)
    motion = two_motions.background(graph, graph, cameras(graph, scene), FocalPrior(1.1 * graph.width))
    assert motion is not None
    moves = graph.resample(scene.dynamic.astype(float), 1) > 0.5
    assert motion.fits[~moves].mean() > 0.7
    assert motion.fits[moves].mean() < 0.1


@pytest.mark.parametrize(("shaken", "told"), [(0.0, True), (0.3, True), (0.6, False)])
def test_two_motions_that_explain_little_tell_nothing(
    shaken: float, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where most of the view fits no rigid motion, as in a crowd, some part of it still fits one better than before."""
    scene, rng = beside(), np.random.default_rng(0)
    graph = observe(scene, stride=6, masked=False, noise_px=NOISE_PX)
    fits_nothing = rng.random(len(graph.pixels)) < shaken
    errors = rng.normal(0, 1, graph.matches.shape) * fits_nothing[:, None]
    graph = replace(graph, matches=graph.matches + errors.astype(np.float32))
    arguments = graph, graph, cameras(graph, scene), FocalPrior(1.1 * graph.width)
    motion = two_motions.background(*arguments)
    assert (motion is not None) == told
    if motion is not None:
        assert trajectory_error(motion.state.cam_from_world, scene.cam_from_world) < 1e-3
    monkeypatch.setattr(two_motions, "TOGETHER", 0.0)
    assert two_motions.background(*arguments) is not None


def against(radius: float, shake: float) -> Scene:
    """A disc that comes at twice the speed of a camera whose hand shakes up and down."""
    twists = np.zeros((8, 6))
    twists[:, 0], twists[:, 2] = 0.06 * np.arange(8), -0.018 * np.arange(8)
    twists[:, 1] = shake * np.array([0, 1, -1, 0.5, -0.7, 1, -0.3, 0.6])
    return make_scene(T=8, size=(96, 144), disc_radius=radius, velocity=(0.12, 0, -0.036), path=lie.exp_se3(twists))


@pytest.mark.parametrize(("radius", "shake", "enough"), [(0.8, 0.05, False), (0.6, 0.02, True)])
def test_what_comes_the_other_way_is_told_by_what_lies_along_the_border(
    radius: float, shake: float, enough: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It looks like something near at rest before cameras that do not shake, even from the true ones on.

    So it does if these cameras explain `enough` that no mover that travels along is looked for.
    """
    scene = against(radius, shake)
    graph = observe(scene, stride=6, masked=False, noise_px=NOISE_PX)
    moves = graph.resample(scene.dynamic.astype(float), 1) > 0.5
    mixed = cameras(graph, scene)
    fits = two_motions.fitting(graph, mixed)
    assert (two_motions.share(fits, two_motions.matched_pixels(graph)) > two_motions.EXPLAINED) == enough
    assert fits[moves].mean() > 0.9
    assert trajectory_error(mixed.cam_from_world, scene.cam_from_world) > 0.02
    motion = two_motions.background(graph, graph, mixed, FocalPrior(1.1 * graph.width))
    assert motion is not None
    assert motion.fits[~moves].mean() > 0.8
    assert motion.fits[moves].mean() < 0.1
    assert trajectory_error(motion.state.cam_from_world, scene.cam_from_world) < 0.003
    monkeypatch.setattr(two_motions, "border", lambda graph: np.zeros(len(graph.pixels), bool))
    assert two_motions.background(graph, graph, mixed, FocalPrior(1.1 * graph.width)) is None


@pytest.mark.parametrize(("radius", "shake"), [(0.8, 0.05), (0.6, 0.02)])
def test_cameras_of_two_motions_fit_neither_to_the_scale_of_the_noise(
    radius: float, shake: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the border does not tell, what both fit does: closer by the cameras of the world."""
    scene = against(radius, shake)
    graph = observe(scene, stride=6, masked=False, noise_px=NOISE_PX)
    moves = graph.resample(scene.dynamic.astype(float), 1) > 0.5
    mixed, prior = cameras(graph, scene), FocalPrior(1.1 * graph.width)
    monkeypatch.setattr(two_motions, "_explain_more", lambda *_: False)
    motion = two_motions.background(graph, graph, mixed, prior)
    assert motion is not None
    assert motion.fits[~moves].mean() > 0.8
    assert motion.fits[moves].mean() < 0.1
    assert trajectory_error(motion.state.cam_from_world, scene.cam_from_world) < 0.003
    true = initialise.initial_state(graph, scene.cam_from_world, scene.focal_px)
    right, found = (two_motions.Motion(of, two_motions.fitting(graph, of)) for of in (true, mixed))
    matched = two_motions.matched_pixels(graph)
    assert two_motions._errors_over(graph, right, found, matched) < 0.8
    assert two_motions._errors_over(graph, found, right, matched) > 1.25
    monkeypatch.setattr(two_motions, "CLOSER", 0.0)
    assert two_motions.background(graph, graph, mixed, prior) is None


@pytest.mark.parametrize(
    ("ratios", "left", "border", "chosen"),
    [
        ((0.8, 0.9, 0.1), True, slice(0, 30), 0),
        ((0.9, 0.9, 0.1), True, slice(0, 30), 2),
        ((0.9, 0.9, 0.1), True, slice(30, 100), None),
        ((0.9, 0.9, 0.9), True, slice(0, 30), None),
        ((0.1, 0.1, 0.1), False, slice(0, 30), None),
    ],
)
def test_of_motions_that_fit_closer_the_one_that_fits_most_is_taken(
    ratios: tuple[float, ...], left: bool, border: slice, chosen: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Few pixels may fit much closer: those of frames in which the camera rests, or of rows that a shutter bends less.

    Motions fit the first 70, 75 and 40 of 100 pixels, the cameras found 60; the border is some of them. Pairs explain
    what is left or not.
    """
    graph, place = observe(beside(), stride=12), np.arange(100)[None]
    states = [State(np.eye(4)[None], np.ones((1, 100)), float(k)) for k in range(4)]
    first, second, third, single = (
        two_motions.Motion(of, place < n) for of, n in zip(states, (70, 75, 40, 60), strict=True)
    )
    monkeypatch.setattr(two_motions, "_errors_over", lambda _graph, of, *_: ratios[int(of.state.focal_px)])
    monkeypatch.setattr(two_motions, "_explain_left", lambda *_: left)
    pairs = [two_motions.Pair(first, third, 0.0), two_motions.Pair(second, third, 0.0)]
    matched, along = np.ones((1, 100), bool), np.zeros(100, bool)
    along[border] = True
    motion = two_motions._closer(graph, pairs, single, matched, along)
    assert (None if motion is None else int(motion.state.focal_px)) == chosen


@pytest.mark.parametrize(
    ("together", "at_border", "told"), [(0.85, 0.7, True), (0.75, 0.7, False), (0.85, 0.55, False)]
)
def test_a_pair_explains_half_of_what_is_left_and_more_of_the_border(
    together: float, at_border: float, told: bool
) -> None:
    """Of 100 pixels, 20 of them along the border, the cameras found fit 60 and 10: a pair is to fit 80 and 12."""
    place, state = np.arange(100), State(np.eye(4)[None], np.ones((1, 100)), 1.0)
    along, matched = place < 20, np.ones((1, 100), bool)
    single = ((place < 10) | (place >= 50))[None]
    first = ((place < round(20 * at_border)) | (place >= 60))[None]
    inside = round(100 * together) - int(first.sum())
    second = ((place >= 60 - inside) & (place < 60))[None]
    pair = two_motions.Pair(two_motions.Motion(state, first), two_motions.Motion(state, second), 0.0)
    assert two_motions._explain_more(pair, single, matched, along) == told


def test_nothing_fits_closer_than_without_any_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Flow of a picture that stands still is zero to the bit."""
    scene = beside(0.0)
    graph = observe(scene, stride=6, masked=False)
    state = initialise.initial_state(graph, scene.cam_from_world, scene.focal_px)
    motion, matched = two_motions.Motion(state, two_motions.fitting(graph, state)), two_motions.matched_pixels(graph)
    monkeypatch.setattr(two_motions.dba, "errors_px", lambda graph, _state: np.zeros_like(graph.weights))
    assert two_motions._errors_over(graph, motion, motion, matched) == 1


def test_all_but_the_farthest_of_what_fits_is_left_out() -> None:
    scene = beside(0.0)
    graph = observe(scene, stride=6, masked=False, noise_px=NOISE_PX)
    state = initialise.initial_state(graph, scene.cam_from_world, scene.focal_px)
    fits = two_motions.fitting(graph, state)
    kept = two_motions._without_near(graph, state, fits)
    assert kept[~fits].all()
    assert kept[fits].mean() == pytest.approx(0.3, abs=0.01)
    depth = graph.resample(scene.depth, 1)
    assert depth[fits & kept].min() > np.median(depth[fits & ~kept])


def test_without_matches_along_the_border_nothing_tells_which_is_the_background() -> None:
    scene = beside()
    graph = observe(scene, stride=6, masked=False, noise_px=NOISE_PX)
    graph = replace(graph, weights=graph.weights * ~two_motions.border(graph))
    assert two_motions.background(graph, graph, cameras(graph, scene), FocalPrior(1.1 * graph.width)) is None


def test_a_handful_of_pixels_does_not_tell_motions_apart() -> None:
    scene = beside()
    graph = observe(scene, stride=12, masked=False, noise_px=NOISE_PX)
    assert len(graph.pixels) < two_motions.PIXELS
    assert two_motions.background(graph, graph, cameras(graph, scene), FocalPrior(1.1 * graph.width)) is None
