"""Where cameras follow movers and ground together, a path at another focal length that follows the border is right."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic import Scene, camera_path, make_scene, observe, trajectory_error

from stages.ba import border_focals, classify, initialise
from stages.ba.border_focals import border_path
from stages.ba.estimate import estimate
from stages.ba.graph import FlowGraph
from stages.ba.guesses import Observed
from stages.ba.initialise import Candidate
from stages.ba.options import BAOptions
from stages.ba.problem import Problem
from stages.ba.solving import _previous
from stages.ba.state import FocalPrior, State
from stages.ba.two_motions import Motion, border, matched_pixels, share
from stages.shared import lie
from stages.shared.cameras import make_cameras, write_cameras

NOISE_PX, LENS = 0.05, 0.69


def beside(path: np.ndarray | None = None) -> Scene:
    """A disc that travels along over a third of the view of a wide lens."""
    return make_scene(
        T=8, size=(96, 144), disc_radius=0.6, velocity=(0.1, -0.06, 0.1), focal=LENS, path=path, travel=1.0
    )


def shaken(path: np.ndarray) -> np.ndarray:
    """Poses [T, 4, 4] that shake by a third of a step."""
    step = np.linalg.norm(np.diff(lie.inverse(path)[:, :3, 3], axis=0), axis=1).mean()
    moved = lie.inverse(path)
    moved[:, :3, 3] += np.random.default_rng(0).normal(0, step / 3, (len(path), 3))
    return lie.inverse(moved)


def asked(
    scene: Scene, found: np.ndarray, lens: float, monkeypatch: pytest.MonkeyPatch
) -> tuple[FlowGraph, Motion | None]:
    """The answer where cameras `found` [T, 4, 4], their lens in image widths, stand in a minimum without a way out."""
    graph = observe(scene, stride=6, masked=False, noise_px=NOISE_PX)
    focal_px, adjusted = lens * graph.width, border_focals.adjusted

    def stuck(observed: Observed, on: FlowGraph, *path: Any) -> State:
        if path[-1].focal:
            return initialise.initial_state(on, found, focal_px)
        return adjusted(observed, on, *path)

    monkeypatch.setattr(border_focals, "adjusted", stuck)
    prior, statistics = FocalPrior(1.1 * graph.width), classify.measure(graph, None, 0)
    observed = Observed(graph, graph, None, [focal_px], statistics, prior, 0)
    best = Candidate("", initialise.initial_state(graph, found, focal_px), 0.0, initialise.roughness(found), [])
    return graph, border_path(observed, graph, graph, best)


def test_a_path_that_follows_the_border_takes_the_place_of_one_that_shakes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = beside()
    graph, motion = asked(scene, shaken(scene.cam_from_world), 1.1, monkeypatch)
    assert motion is not None
    assert motion.state.focal_px == pytest.approx(scene.focal_px, rel=0.13)
    assert trajectory_error(motion.state.cam_from_world, scene.cam_from_world) < 0.02
    assert share(motion.fits, matched_pixels(graph) & border(graph)) > 0.8


def test_cameras_that_follow_the_border_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    chained = []
    monkeypatch.setattr(initialise, "chain", lambda *_: chained.append(_))
    assert asked(beside(), beside().cam_from_world, LENS, monkeypatch)[1] is None
    assert not chained, "nothing is looked for"


def test_a_path_that_is_rougher_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hand that shakes, before cameras that glide and fit little: roughness alone tells that they are not its own."""
    path = shaken(camera_path(8, "curve"))
    graph, motion = asked(beside(path), camera_path(8, "curve"), 1.1, monkeypatch)
    assert motion is None
    assert (
        share(border_focals.fitting(graph, initialise.initial_state(graph, path, LENS * graph.width)), border(graph))
        > 0.5
    )


def test_the_focal_length_is_held_at_that_of_the_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is not freed on what the background alone tells, and not put back to the usual one."""
    scene = beside()
    graph = observe(scene, stride=6, masked=False, noise_px=NOISE_PX)

    def told(_: Observed, plain: FlowGraph, *__: object) -> Motion:
        state = initialise.initial_state(plain, scene.cam_from_world, scene.focal_px)
        return Motion(state, border_focals.fitting(plain, state) & matched_pixels(plain))

    monkeypatch.setattr("stages.ba.start.two_motions.background", lambda *_: None)
    monkeypatch.setattr("stages.ba.start.border_path", told)
    monkeypatch.setattr("stages.ba.refinement.BLIND_FOCAL", 0.0)
    found = estimate(Problem(graph, False), BAOptions(start_focals=(1.05,), zoom="no"))
    assert found.focal["decision"] == "held at prior"
    assert found.focal["prior_sides"] == pytest.approx(LENS)
    assert found.state.focal_px == pytest.approx(scene.focal_px)
    assert found.static is not None
    assert found.static[scene.dynamic].mean() < 0.2


def test_later_rounds_hold_the_focal_length_at_that_of_the_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the matches do not tell it: at the usual one the cameras would follow the movers again."""
    monkeypatch.setattr("stages.ba.refinement.BLIND_FOCAL", 0.0)
    scene = beside()
    graph = observe(scene, stride=6, masked=False, noise_px=NOISE_PX)
    cameras = make_cameras(scene.cam_from_world, scene.K_of(0), np.arange(8))
    for prior_sides, held in ((LENS, LENS), (None, 1.1)):
        write_cameras(tmp_path / "poses.parquet", cameras, {"focal": {"prior_sides": prior_sides}})
        previous = _previous(tmp_path / "poses.parquet", 1.0, graph.width)
        found = estimate(Problem(graph, False, previous=previous), BAOptions(start_focals=(1.05,), zoom="no"))
        assert found.focal["decision"] == "held at prior"
        assert found.state.focal_px / graph.width == pytest.approx(held)
        assert found.focal["prior_sides"] == (prior_sides and pytest.approx(prior_sides))
