"""Which changes of light are modelled: gains, white balance, fog and gloss, each beside the others, against truth."""

from dataclasses import replace
from functools import cache

import finished_run as clip
import numpy as np
import pytest
from square_inputs import observe
from synthetic import PLANE, flow_arrays, make_scene

from stages.scene import light, photometry, rules, sightings
from stages.scene.light_model import Light, Model, cleared, no_light
from stages.scene.observed import Observed
from stages.scene.photometry import LightEvidence, ViewEvidence, light_evidence, view_evidence
from stages.scene.sightings import sight
from stages.scene.weigh import NOTHING, Bought
from stages.scene.windows import FOOTPRINT_PX2, SMOOTH_PX, WIDEST, Windows, windows
from stages.shared.cameras import pixel_grid, unproject
from stages.shared.images import DISPLAY_GAMMA

NOISE = 0.01


@cache
def room(wall: bool = False) -> tuple:
    """A room that the camera goes into, or a slanted wall that it goes to, and the flow of its neighbouring frames."""
    ahead = np.tile(np.eye(4), (8, 1, 1))
    ahead[:, [0, 2], 3] = np.linspace((0, 0), (0.35, -1), 8)
    scene = make_scene(size=(96, 160), planes=PLANE, path=ahead) if wall else make_scene(size=(96, 160))
    return scene, flow_arrays(scene, (1,))


def lit_room(
    extinction: float = 0.0,
    airlight: tuple[float, float, float] = (0.6, 0.6, 0.6),
    gains: np.ndarray | float = 1.0,
    grey: bool = False,
    wall: bool = False,
) -> Observed:
    """The room in fog of linear radiance `airlight`, with gains per frame [T, 3]."""
    scene, (source, target, flow, visible) = room(wall)
    gains = np.broadcast_to(np.asarray(gains, float), (scene.T, 3))
    rng, rgb = np.random.default_rng(0), []
    for k, (depth, pose) in enumerate(zip(scene.depth, scene.cam_from_world, strict=True)):
        points = unproject(pixel_grid(96, 160), depth, pose, scene.K)
        x, y, z = np.moveaxis(points, -1, 0)
        shade = 0.3 + 0.25 * np.sin(3 * x + z) * np.cos(4 * y + 2 * z)
        surface = shade[..., None] * (np.ones(3) if grey else np.array([1.0, 0.8, 0.6]))
        distance = np.linalg.norm(points - np.linalg.inv(pose)[:3, 3], axis=-1)[..., None]
        clear = np.exp(-extinction * distance)
        shown = gains[k] * (clear * surface + (1 - clear) * np.array(airlight)) ** (1 / DISPLAY_GAMMA)
        noise = NOISE * rng.standard_normal((*depth.shape, 1 if grey else 3))
        rgb.append(np.clip(np.rint(255 * (shown + noise)), 0, 255) / 255)
    return Observed(
        rgb=np.stack(rgb).astype(np.float32),
        dynamic=np.zeros(scene.depth.shape, bool),
        instances=np.zeros(scene.depth.shape, np.uint16),
        depth=scene.depth,
        cam_from_world=scene.cam_from_world,
        Ks=np.broadcast_to(scene.K, (scene.T, 3, 3)),
        edges=np.stack([source, target], axis=1),
        flow=flow,
        confidence=visible,
        offsets=target - source,
    )


def drift(percent: float) -> np.ndarray:
    """A gain [T, 1] that grows by so many per cent."""
    return np.exp(np.linspace(0, np.log1p(percent / 100), room()[0].T))[:, None]


def tint(share: float) -> np.ndarray:
    """Gains [T, 3] of red and blue that go opposite ways."""
    return 1 + share * np.linspace(-1, 1, room()[0].T)[:, None] * np.array([1, 0, -1])


def decided(evidence: LightEvidence) -> tuple[bool, bool, bool]:
    """Whether gains, gains per channel beside them, and fog buy enough."""
    parts = ((evidence.exposure, False), (evidence.white_balance, False), (evidence.atmosphere, True))
    exposure, white_balance, fog = (photometry.is_worth(bought, is_fog) for bought, is_fog in parts)
    return exposure, white_balance, fog


@pytest.mark.parametrize("count", [215, 350, 1000])
def test_every_frame_of_a_long_clip_is_seen_by_static_points(count: int) -> None:
    h, w = 24, 36
    shade = np.random.default_rng(0).uniform(0.3, 0.6, (h, w, 3)).astype(np.float32)
    poses = np.tile(np.eye(4), (count, 1, 1))
    K = np.array([[30.0, 0, w / 2], [0, 30.0, h / 2], [0, 0, 1]])
    none, one = np.zeros((count, h, w), bool), np.ones((h, w))
    rgb, depth = (np.broadcast_to(x, (count, *x.shape)) for x in (shade, one))
    links = np.zeros((0, 2), int), np.zeros((0, h, w, 2)), np.zeros((0, h, w)), np.zeros(0, int)
    points = sight(Observed(rgb, none, none, depth, poses, np.broadcast_to(K, (count, 3, 3)), *links))
    assert 300 < len(points.points) <= 700
    assert points.usable.any(axis=2).sum(axis=0).min() > 100


@pytest.mark.parametrize("drift_percent", [0.0, 15.0])
@pytest.mark.parametrize(("extinction", "level"), [(0.0, 0.7), (0.15, 0.7), (0.4, 0.05)])
def test_fog_is_told_from_exposure(extinction: float, level: float, drift_percent: float) -> None:
    """On the way into fog everything darkens or brightens, near and far alike."""
    evidence = light_evidence(sight(lit_room(extinction, (level, level, 1.2 * level), drift(drift_percent))))
    found = rules.decide_exposure(evidence, "auto")
    foggy = extinction > 0
    assert decided(evidence) == (drift_percent > 0, False, foggy)
    assert found["needed"] == (drift_percent > 0)
    assert found["evidence"]["gain_range_percent"] == pytest.approx(drift_percent, abs=1 + 15 * extinction)
    assert found["interval"][0] < found["statistic"] < found["interval"][1]
    # The airlight of dark fog is bounded below, and its extinction comes out too low for that.
    assert evidence.fitted.extinction == pytest.approx(extinction * foggy, abs=0.4 * extinction)
    air = rules.decide_atmosphere(evidence, "auto")
    assert air["needed"] == foggy
    assert air["extinction"] == evidence.fitted.extinction
    if foggy:
        brighter = np.exp(DISPLAY_GAMMA * np.log(drift(drift_percent)).mean())  # fitted gains are 1 on average
        expected = level * brighter * np.array([1, 1, 1.2])
        assert evidence.fitted.airlight == pytest.approx(expected, abs=0.03)


def test_what_is_burnt_in_is_no_point_of_the_scene() -> None:
    room, scene = lit_room(), np.ones((96, 160), bool)
    scene[10:50, 100:150] = False
    logo = np.array([0.1, 0.9, 0.1])
    shown = replace(room, rgb=np.where(scene[..., None], room.rgb, logo).astype(np.float32))
    for known, found in ((None, True), (scene, False)):
        seen = sight(replace(shown, scene=known))
        green = seen.colours[..., 1] - seen.colours[..., 0] > 0.4
        assert (green & seen.usable.all(axis=2)).any() == found


def test_smoothing_mixes_nothing_hidden_in() -> None:
    """It is wider where points are nearer: what is burnt in, white here, must not brighten the points beside it."""
    wall, scene = lit_room(wall=True), np.ones((96, 160), bool)
    scene[10:80, 60:110] = False
    shown = replace(wall, rgb=np.where(scene[..., None], wall.rgb, np.float32(1)), scene=scene)
    brightest = [found.colours[found.usable].max() for found in map(sight, (wall, shown))]
    assert brightest[1] < brightest[0] + 0.02


def test_a_sky_behind_black_fog_has_errors_all_the_same() -> None:
    """Nothing is left of its light: e^-1000. A search for fog may pass through an airlight of zero."""
    seen = sight(lit_room())
    far = seen._replace(distance=np.where(seen.cell[:, None] == 3, np.float32(2e4), seen.distance))
    black = replace(no_light(seen.colours.shape[1]), extinction=0.05)
    errors = light.residuals(far, black, np.ones(len(seen.cell), bool))
    assert np.isfinite(errors).all()
    assert np.isfinite(light.fit(far, Model(0, True), seen.odd, black).airlight).all()
    assert np.isfinite(cleared(far, black)).all()


@pytest.mark.parametrize("wall", [True, False])
@pytest.mark.parametrize(
    ("extinction", "level"), [(0.02, 0.6), (0.05, 0.6), (0.2, 0.6), (0.4, 0.6), (0.1, 0.9), (0.08, 0.9), (0.3, 0.6)]
)
def test_thin_and_thick_fog_are_found_from_a_light_without(extinction: float, level: float, wall: bool) -> None:
    """0.1 to 1.6 per median distance. The vignetting that is fitted first takes the part of thin fog.

    At first thin bright fog explains more than the true one; then extinction and airlight lie in a long curved valley.
    In the room, thin fog comes out a third too thin where windows are as long as wide: the camera goes past a wall.
    """
    found = fitted_fog(lit_room(extinction, (level, level, 1.1 * level), wall=wall))
    assert found.extinction == pytest.approx(extinction, rel=0.08)
    assert found.airlight == pytest.approx([level, level, 1.1 * level], rel=0.06)


def fitted_fog(shown: Observed) -> Light:
    """Fog, and a vignetting, that fit the points of all cells best, whether they are worth a model or not."""
    seen = sight(shown)
    every, start = np.ones(len(seen.cell), bool), no_light(seen.colours.shape[1])
    return light.fit(seen, Model(0, True), every, light.fit(seen, Model(0, False), every, start))


def test_windows_cover_the_same_of_a_surface_in_all_frames() -> None:
    """In no frame less than SMOOTH_PX of the image, and where one of them is wide it is not the others as well."""
    turns = np.linspace(0.2, 1.0, 4)
    J = np.stack([np.array([[1.3 * np.cos(a), 0.2], [0.1, 1.0 + 0.2 * a]]) for a in turns])  # px per place
    square = np.array([[0, 0], [5, 0], [0, 5], [5, 5]], float)
    corners = np.einsum("fij,cj->cfi", J, square)[None]
    shown = np.ones((1, 5), bool)
    shown[0, 4] = False
    found = windows(np.concatenate([corners, np.full((1, 4, 1, 2), 7.0)], axis=2), shown)
    along, across = found.along[0, :4], found.variance[0, :4]
    image = across[:, None, None] * np.eye(2) + along[:, :, None] * along[:, None] + FOOTPRINT_PX2 * np.eye(2)
    surface = np.linalg.inv(J) @ image @ np.swapaxes(np.linalg.inv(J), 1, 2)
    assert surface == pytest.approx(np.broadcast_to(surface[0], surface.shape), rel=1e-6, abs=1e-6)
    assert across.min() == pytest.approx(SMOOTH_PX**2, rel=1e-6)
    assert found.reach.max() < WIDEST * SMOOTH_PX
    assert np.isfinite(found.reach).all()


def test_a_square_that_is_seen_edge_on_has_the_longest_windows() -> None:
    corners = np.array([[0.0, 0], [5, 0], [0, 5], [5, 5]])[None, :, None] * np.array([[1, 1], [1, 1e-4]])[:, None, None]
    found = windows(np.swapaxes(corners, 0, 1).reshape(1, 4, 2, 2), np.ones((1, 2), bool))
    assert found.reach.max() == pytest.approx(WIDEST * SMOOTH_PX)
    assert found.variance.min() >= SMOOTH_PX**2 - 1e-9


@pytest.mark.parametrize("shape", [np.zeros((2, 2)), np.array([[1.0, 0], [0, 0]])], ids=["point", "line"])
def test_a_square_that_collapses_in_a_frame_leaves_the_windows_of_the_others(shape: np.ndarray) -> None:
    square = np.array([[0.0, 0], [5, 0], [0, 5], [5, 5]])
    corners = np.stack([square, square * (0.8, 0.6), square @ shape.T], axis=1)[None]
    collapsed = windows(corners, np.ones((1, 3), bool))
    without = windows(corners[:, :, :2], np.ones((1, 2), bool))
    assert collapsed.variance[:, :2] == pytest.approx(without.variance)
    assert np.abs(collapsed.along[:, :2]) == pytest.approx(np.abs(without.along))
    assert np.isfinite(collapsed.reach).all()


def test_a_window_that_reaches_beyond_the_picture_is_not_seen() -> None:
    """There it would repeat the border."""
    uv = np.array([[[10.0, 10.0], [3.0, 10.0], [10.0, 0.0], [36.0, 10.0]]])
    along = np.broadcast_to([2.0, 0.0], uv.shape)
    found = sightings._is_within(uv, Windows(np.ones((1, 4)), along), (20, 40))
    assert found.tolist() == [[True, False, True, False]]


def test_texture_that_fades_with_distance_is_no_fog() -> None:
    """Smoothed over as many pixels at all distances, it does: that is an extinction of 0.013 here."""
    assert fitted_fog(lit_room(wall=True)).extinction < 0.003


@pytest.mark.parametrize(("exposure", "white_balance"), [(15.0, 0.1), (15.0, 0.0), (0.0, 0.1)])
def test_white_balance_is_told_from_exposure(exposure: float, white_balance: float) -> None:
    evidence = light_evidence(sight(lit_room(gains=drift(exposure) * tint(white_balance))))
    assert decided(evidence) == (exposure > 0, white_balance > 0, False)
    expected = np.log(drift(exposure) * tint(white_balance))
    assert evidence.fitted.log_gains == pytest.approx(expected - expected.mean(axis=0), abs=0.01)


def test_gains_per_channel_do_not_bring_back_an_exposure_that_is_ruled_out() -> None:
    evidence = light_evidence(sight(lit_room(gains=drift(15.0) * tint(0.1))))
    assert rules.decide_white_balance(evidence, "auto")["needed"]
    ruled_out = rules.decide_white_balance(evidence, "auto", exposure="no")
    assert (ruled_out["needed"], ruled_out["source"]) == (False, "user")
    assert rules.decide_white_balance(evidence, "yes", exposure="no")["needed"]


def test_fog_that_is_asked_for_in_clear_air_is_not_modelled() -> None:
    evidence = light_evidence(sight(lit_room()))
    found = rules.decide_atmosphere(evidence, "yes")
    assert (evidence.fitted.extinction, found["needed"]) == (0, False)
    assert "clear air" in found["why"]


def test_vignetting_that_moves_over_the_scene_is_no_gain() -> None:
    """A camera that goes on sees what was in the corner, and dark, in the middle."""
    seen = lit_room()
    v, u = np.mgrid[-1:1:96j, -1:1:160j]
    seen.rgb[:] *= (1 - 0.25 * (u**2 + v**2) / 2)[None, ..., None]
    assert decided(light_evidence(sight(seen))) == (False, False, False)


def smooth_pictures(shine: float = 0.0) -> np.ndarray:
    """Frames [T, H, W, 3] of a softly shaded wall, and a shine that depends on the view only."""
    images = []
    for k in range(clip.T):
        points, _ = clip.wall(k)
        shade = 0.4 + 0.1 * np.sin(2 * points[..., 0]) * np.cos(3 * points[..., 1])
        rays = points - clip.CENTRES[k]
        direction = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        images.append(shade + shine * direction[..., 0])
    return np.repeat(np.stack(images)[..., None], 3, axis=-1)


def view_decision(images: np.ndarray, choice: rules.Choice = "auto") -> rules.Decision:
    return rules.decide_view_dependent(view_evidence(sight(observe(images)), no_light(clip.T)), choice)


def test_view_dependence_is_predicted_at_other_times_and_places() -> None:
    noise = np.random.default_rng(0).normal(0, 0.03, clip.T)[:, None, None, None]
    assert view_decision(smooth_pictures())["sh_degree"] == 0
    assert view_decision(smooth_pictures() + noise)["sh_degree"] == 0
    assert view_decision(smooth_pictures(), "yes")["sh_degree"] == 1
    shiny = view_decision(smooth_pictures(shine=0.5))
    assert shiny["sh_degree"] >= 1
    assert shiny["evidence"]["share_degree1"] > 0.8


@pytest.mark.parametrize(
    ("grey", "share", "rank_sigmas", "needed"),
    [(1.3, 0.41, 2.1, True), (1.1, 0.41, 2.1, False), (1.3, 0.39, 2.1, False), (1.3, 0.41, 1.9, False)],
)
def test_highlights_must_be_large_a_large_share_and_beyond_chance(
    grey: float, share: float, rank_sigmas: float, needed: bool
) -> None:
    bought = Bought(grey**2, 9.0, grey**2 / share, 100, rank_sigmas)
    decision = rules.decide_view_dependent(ViewEvidence((bought, NOTHING), 10.0), "auto")
    assert decision["needed"] == needed
    assert decision["threshold"] == rules.MIN_VIEW_GREY
    assert decision["evidence"]["rank_sigmas"] == rank_sigmas


def test_harmonics_of_noise_are_shrunk_to_nothing() -> None:
    """Not fitted as they are: they would predict changes of neighbours where nothing shines."""
    random = np.random.default_rng(0)
    basis, noise = random.normal(size=(50, 2, 20, 3)), random.normal(size=(50, 2, 20, 3))
    fitted = np.ones((50, 2, 20), bool)
    assert (photometry._coefficients(noise, basis, fitted) == 0).mean() > 0.95
    shine = basis @ random.normal(size=(50, 1, 3, 3))
    clear = photometry._coefficients(shine + 0.1 * noise, basis, fitted)
    assert np.abs(basis @ clear[:, None] - shine).max() < 0.05 * np.abs(shine).max()


def test_fog_and_gains_have_thresholds_of_their_own() -> None:
    evidence = light_evidence(sight(lit_room()))
    assert rules.decide_atmosphere(evidence, "auto")["threshold"] == photometry.LEAST_FOG_GREY
    assert rules.decide_exposure(evidence, "auto")["threshold"] == photometry.LEAST_GREY


def test_light_is_fitted_to_different_groups_spread_over_all() -> None:
    seen = sight(lit_room())
    count = len(seen.cell) // photometry.GROUP
    some = photometry._some_groups(seen)
    assert count > photometry.LIGHT_GROUPS == len(some.cell) // photometry.GROUP
    assert len(np.unique(some.points, axis=0)) > 0.95 * len(some.points)  # references see some points twice
    assert (some.points[-1] == seen.points[-1]).all()


def test_a_texture_that_slides_over_the_depth_is_no_gloss() -> None:
    """Poses that are wrong by up to a pixel make each point's colour change smoothly, by its own surroundings."""
    images = []
    for k in range(clip.T):
        points, _ = clip.wall(k)
        x, y = points[..., 0] + 0.06 * k / clip.T, points[..., 1]
        images.append(0.5 + 0.06 * np.sin(17 * x) * np.cos(19 * y))
    decision = view_decision(np.repeat(np.stack(images)[..., None], 3, axis=-1))
    assert decision["sh_degree"] == 0
    assert decision["statistic"] < 0.7 * rules.MIN_VIEW_GREY
