"""Hard cases of radial distortion: where it cannot be told from a pinhole, and what could be mistaken for it."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from synthetic import PLANE, Scene, camera_path, make_scene, observe

from stages.ba import distortion
from stages.ba.distortion import Lens, find_lens
from stages.ba.graph import FlowGraph
from stages.ba.guesses import Observed
from stages.ba.state import FocalPrior, State
from stages.shared import lie

T = 8
K = np.array([-0.15, 0.0])
FACING = (((0.0, 0.0, 1.0), 4.0),)
"""A plane across the optical axis."""


def decide(graph: FlowGraph, assumed: bool = False) -> Lens:
    return find_lens(graph, FocalPrior(1.1 * graph.width), seed=0, assumed=assumed)


def view(lens: np.ndarray | None = K, **scene: object) -> tuple[FlowGraph, float]:
    """Noisy matches of a scene, and its focal length over the distance of a corner."""
    room = make_scene(T=T, size=(96, 160), lens=lens, **scene)  # type: ignore[arg-type]
    graph = observe(room, noise_px=0.1, masked=False)
    return graph, room.focal_px / graph.corner_px


def dolly() -> np.ndarray:
    """Poses [T, 4, 4] of a camera that moves forward along its axis."""
    return np.asarray(lie.exp_se3(np.outer(np.linspace(0, 1.5, T), [0, 0, -1, 0, 0, 0])))


@pytest.mark.parametrize("lens", [None, K], ids=["pinhole", "lens"])
def test_a_dolly_towards_a_plane_does_not_show_a_distortion(lens: np.ndarray | None) -> None:
    """All flow is along the radius, where the depths of the pixels explain it."""
    found = decide(view(lens, path=dolly(), planes=FACING)[0])
    assert (found.coefficients, found.evidence.decision) == (None, "not observable")


@pytest.mark.parametrize(
    ("sigma", "assumed", "is_searched"), [(0.035, False, True), (0.05, False, False), (0.05, True, True)]
)
def test_a_distortion_that_is_far_from_observable_is_not_searched(
    sigma: float, assumed: bool, is_searched: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unless it is asked for: better cameras may show it."""
    searched, search = [], distortion._search

    def counted(observed: Observed, shift: float) -> State:
        searched.append(shift)
        return search(observed, shift)

    monkeypatch.setattr(distortion, "_shift_sigma", lambda *_: sigma)
    monkeypatch.setattr(distortion, "_search", counted)
    found = decide(view()[0], assumed)
    assert (found.evidence.decision, bool(searched)) == ("not observable", is_searched)


def test_a_camera_that_hardly_moves_does_not_show_a_distortion() -> None:
    found = decide(view(motion="still")[0])
    assert (found.coefficients, found.evidence.decision) == (None, "not observable")


def test_matches_near_the_centre_alone_do_not_show_a_distortion() -> None:
    graph, _ = view()
    near = np.linalg.norm(graph.pixels - graph.centre, axis=1) < 0.35 * graph.corner_px
    found = decide(replace(graph, weights=graph.weights * near.astype(np.float32)))
    assert (found.coefficients, found.evidence.decision) == (None, "not observable")


@pytest.mark.parametrize("motion", ["curve", "rotate"])
def test_a_camera_that_moves_or_turns_shows_it(motion: str) -> None:
    graph, ratio = view(motion=motion)
    found = decide(graph)
    assert found.evidence.decision == "distorted"
    assert found.coefficients is not None
    assert_allclose(found.coefficients[0] * ratio**2, K[0], rtol=0.06)
    assert found.coefficients[1] == 0


def test_a_moving_disc_is_no_distortion_and_hides_none() -> None:
    assert decide(view(None, disc_radius=0.6)[0]).coefficients is None
    graph, ratio = view(disc_radius=0.6)
    found = decide(graph)
    assert found.coefficients is not None
    assert_allclose(found.coefficients[0] * ratio**2, K[0], rtol=0.1)


@pytest.mark.parametrize(
    "scene", [{"motion": "rotate"}, {"planes": PLANE}, {"path": dolly()}], ids=["turn", "plane", "dolly"]
)
def test_pinholes_are_not_taken_for_lenses(scene: dict[str, object]) -> None:
    assert decide(view(None, **scene)[0]).coefficients is None


def zooming(ratio: float) -> dict[str, object]:
    """A camera on a curve whose focal length changes by this much; its mean logarithm is that of the scene."""
    return {"path": camera_path(T, "curve"), "zoom": np.exp(-np.log(ratio) * np.cos(np.linspace(0, np.pi, T)) / 2)}


def test_a_zoom_is_no_distortion() -> None:
    assert decide(view(None, **zooming(1.3))[0]).coefficients is None


def test_a_zoom_hides_no_distortion(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a lens that moves a pixel of every frame alike, as the adjustment has it."""

    def fixed(scene: Scene) -> Scene:
        return replace(scene, zoom=None)

    pinhole, pictured = Scene.pinhole, Scene.pictured
    monkeypatch.setattr(Scene, "pinhole", lambda scene, pixels, k: pinhole(fixed(scene), pixels, k))
    monkeypatch.setattr(Scene, "pictured", lambda scene, pixels, k: pictured(fixed(scene), pixels, k))
    graph, ratio = view(**zooming(1.15))
    found = decide(graph)
    assert found.evidence.decision == "distorted"
    assert found.coefficients is not None
    assert found.evidence.shift_sigma is not None
    assert abs(found.coefficients[0] - K[0] / ratio**2) < 3 * found.evidence.shift_sigma
    assert_allclose(found.coefficients[0] * ratio**2, K[0], rtol=0.06)


def test_a_strong_lens_has_two_coefficients() -> None:
    k = np.array([-0.3, 0.1])
    graph, ratio = view(k, focal=0.6)
    found = decide(graph)
    assert found.coefficients is not None
    assert found.coefficients[1] != 0
    assert_allclose(found.coefficients * ratio ** np.array([2, 4]), k, rtol=0.15)


def test_a_distortion_before_too_long_a_lens_is_taken_where_it_is_asked_for_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Cameras that follow smeared movers over 40 % of a street had one 4.5 times too long, and bent it by 3.7 %."""
    graph, ratio = view()
    sides = ratio * graph.corner_px / graph.long_side_px
    assert decide(graph).evidence.decision == "distorted"
    monkeypatch.setattr(distortion, "LONG_FOCAL", 0.9 * sides)
    found = decide(graph)
    assert (found.coefficients, found.evidence.decision) == (None, "not observable")
    assert f"the focal length is {sides:.1f} longer sides" in found.evidence.reason
    assert decide(graph, assumed=True).coefficients is not None
