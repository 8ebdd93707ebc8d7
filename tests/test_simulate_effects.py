"""Effects of the final pass: each runs only where a scene lists it, and does what its parameters say."""

from typing import Any

import numpy as np
import pytest

from stages.simulate import effects, frames
from stages.simulate.effect_models import Effects
from stages.simulate.frames import Stage
from stages.simulate.scene import Scene

ALL: dict[str, dict[str, Any]] = {
    "shadows": {"darkness": 0.9},
    "specular": {"exponent": 20, "strength": 2},
    "fog": {"density": 0.2, "colour": [0.5, 0.6, 0.7]},
    "motion_blur": {"shutter": 0.5, "samples": 3},
    "rolling_shutter": {"readout": 0.8},
    "defocus": {"focus": 2.0, "aperture_px": 3},
    "vignette": {"strength": 0.5},
    "flicker": {"amplitude": 0.2, "rows": 20, "hz": 5},
    "exposure": {"stops": 1, "white_balance": 0.2},
    "noise": {"photons": 1000, "read": 0.01},
}
OBJECTS = [
    {"name": "ground", "kind": "terrain", "size": [20, 20], "relief": 0, "texture": {"gloss": 1}},
    {"name": "ball", "kind": "sphere", "radii": [0.5, 0.5, 0.5], "position": [0, 0, 1], "texture": {"gloss": 1}},
]


def make_stage(listed: dict[str, dict[str, Any]], moving: bool = True) -> Stage:
    keys = [{"time": 0, "eye": [0, -4, 1.5], "target": [0, 0, 0.8]}]
    if moving:
        keys.append({"time": 1, "eye": [2.4, -4, 1.5], "target": [2.4, 0, 0.8]})
    scene = Scene(description="", frames=4, width=96, height=48, camera={"keys": keys}, objects=OBJECTS, effects=listed)
    return frames.set_stage(scene, seed=0)


def draw(stage: Stage, frame: int = 1) -> tuple[np.ndarray, np.ndarray, frames.Seen]:
    """Clean and final radiance [H, W, 3] and what was seen."""
    now = stage.moment(frame)
    seen = frames.see(stage, now)
    clean = frames.develop(stage, now, seen, with_effects=False)
    return clean, frames.final(stage, frame, now, seen, clean.copy()), seen


def test_this_file_covers_every_effect() -> None:
    assert set(ALL) == set(Effects.model_fields)


@pytest.mark.parametrize("name", [*ALL, None])
def test_only_listed_effects_run(name: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: dict[str, int] = {}
    of_time = ("motion_blur", "rolling_shutter")
    modules = {effect: (frames, f"_{effect}") if effect in of_time else (effects, effect) for effect in ALL}

    def counted(effect: str, run: Any) -> Any:
        def call(*args: Any) -> Any:
            calls[effect] = calls.get(effect, 0) + 1
            return run(*args)

        return call

    for effect, (module, function) in modules.items():
        monkeypatch.setattr(module, function, counted(effect, getattr(module, function)))
    stage = make_stage({name: ALL[name]} if name else {})
    clean, final, _ = draw(stage)
    assert set(calls) == ({name} if name else set())
    assert set(stage.watch.calls) - {"scene", "geometry"} == set(calls), "the clock and the calls agree on what ran"
    assert np.array_equal(clean, final) == (name is None)


def test_clean_never_has_effects() -> None:
    assert np.array_equal(draw(make_stage({}))[0], draw(make_stage(ALL))[0])


def test_shadows_only_darken_and_only_where_the_sun_is_hidden() -> None:
    clean, final, seen = draw(make_stage({"shadows": {"darkness": 1.0}}))
    ground = (seen.hits.face >= 0) & (seen.surface.normal[:, 2] > 0.999)
    assert (final <= clean + 1e-12).all()
    darker = (final < clean - 1e-9).any(axis=2).ravel()
    sun = np.array([-0.4, -0.5, 0.8]) / np.linalg.norm([-0.4, -0.5, 0.8])
    to_ball = np.array([0, 0, 1.0]) - seen.hits.point
    along = to_ball @ sun
    distance = np.sqrt((to_ball**2).sum(axis=1) - along**2)
    away_from_edges = ground & ~np.isin(np.arange(len(ground)), seen.edges)
    inner, outer = away_from_edges & (distance < 0.48), away_from_edges & (distance > 0.52)
    assert inner.sum() > 50
    assert darker[inner].all()
    assert not darker[outer].any()


def test_specular_is_brightest_at_the_mirror_direction() -> None:
    clean, final, seen = draw(make_stage({"specular": {"exponent": 50, "strength": 1}}))
    added = (final - clean).sum(axis=2).ravel()
    peak = added.argmax()
    centre = make_stage({}).view(1).centre
    view = (centre - seen.hits.point[peak]) / np.linalg.norm(centre - seen.hits.point[peak])
    sun = np.array([-0.4, -0.5, 0.8]) / np.linalg.norm([-0.4, -0.5, 0.8])
    mirrored = 2 * seen.surface.normal[peak] * (seen.surface.normal[peak] @ sun) - sun
    assert view @ mirrored > 0.97
    assert (added >= -1e-12).all()


def test_fog_follows_beer_and_lambert() -> None:
    clean, final, seen = draw(make_stage({"fog": {"density": 0.3, "colour": [0.5, 0.6, 0.7]}}))
    centre = make_stage({}).view(1).centre
    through = np.exp(-0.3 * np.linalg.norm(seen.hits.point - centre, axis=1))[:, None]
    expected = through * clean.reshape(-1, 3) + (1 - through) * [0.5, 0.6, 0.7]
    inner = np.setdiff1d(np.arange(len(expected)), seen.edges)
    assert np.allclose(final.reshape(-1, 3)[inner], expected[inner])
    assert np.allclose(final[0, 0], [0.5, 0.6, 0.7], atol=1e-6), "the sky is all fog"


def test_motion_blur_smears_along_the_motion_only() -> None:
    """The camera slides along x: what is left of the contrast between neighbours along x, and along y."""
    blur = {"motion_blur": {"shutter": 1.0, "samples": 12}}

    def left(axis: int, moving: bool) -> float:
        clean, final, seen = draw(make_stage(blur, moving))
        ground = (seen.surface.normal[:, 2] > 0.9).reshape(clean.shape[:2])
        inner = (ground & np.roll(ground, -1, axis))[:-1, :-1]
        steps = [np.abs(np.diff(picture, axis=axis))[: len(inner), : inner.shape[1]] for picture in (final, clean)]
        return float(steps[0][inner].mean() / steps[1][inner].mean())

    assert left(1, moving=True) < 0.7 * left(0, moving=True)
    assert left(1, moving=False) > 0.8 * left(0, moving=False)


@pytest.mark.parametrize("count", [2, 4, 7, 32])
def test_motion_blur_does_not_shift_the_picture(count: int) -> None:
    offsets = frames.pixel_offsets(count)
    assert np.abs(offsets.mean(axis=0)).max() < 1e-12
    assert np.abs(offsets).max() < 0.75
    assert np.abs(offsets[:, None] - offsets).max(axis=2)[~np.eye(count, dtype=bool)].min() > 0.3 / np.sqrt(count)


def test_defocus_spares_the_focal_plane_and_keeps_brightness() -> None:
    rng = np.random.default_rng(0)
    picture = rng.uniform(0, 1, (40, 60, 3))
    lens = Effects(defocus={"focus": 3.0, "aperture_px": 4.0}).defocus
    assert lens is not None
    assert np.array_equal(effects.defocus(lens, picture, np.full((40, 60), 3.0)), picture)
    blurred = effects.defocus(lens, picture, np.full((40, 60), 12.0))
    assert blurred[8:-8, 8:-8].std() < 0.3 * picture.std()
    assert blurred.mean() == pytest.approx(picture.mean(), rel=0.01)


def test_defocus_does_not_smear_a_sharp_object_over_the_blurred_background() -> None:
    depth = np.full((40, 60), 50.0)
    depth[:, :30] = 3.0
    picture = np.where(depth[..., None] < 10, 1.0, 0.0) * np.ones(3)
    lens = Effects(defocus={"focus": 3.0, "aperture_px": 4.0}).defocus
    assert lens is not None
    blurred = effects.defocus(lens, picture, depth)
    assert (blurred[:, :29] > 0.99).all(), "the sharp object keeps its edge"


def test_noise_has_the_stated_variance_and_is_seeded() -> None:
    sensor = Effects(noise={"photons": 500, "read": 0.02}).noise
    assert sensor is not None
    for level in (0.0, 0.25, 1.0):
        picture = np.full((120, 120, 3), level)
        noisy = effects.noise(sensor, picture, 3, seed=1)
        assert (noisy - level).var() == pytest.approx(level / 500 + 0.02**2, rel=0.05)
        assert np.array_equal(noisy, effects.noise(sensor, picture, 3, seed=1))
        assert not np.array_equal(noisy, effects.noise(sensor, picture, 4, seed=1))


def test_exposure_drifts_within_its_range_and_smoothly() -> None:
    drift = Effects(exposure={"stops": 1.5, "white_balance": 0.2}).exposure
    assert drift is not None
    grey = np.full((1, 1, 3), 0.5)
    gains = np.array([effects.exposure(drift, grey, time, seed=2)[0, 0] / 0.5 for time in np.linspace(0, 1, 200)])
    stops = np.log2(gains[:, 1])
    assert np.abs(stops).max() <= 1.5
    assert np.ptp(stops) > 0.5
    assert np.abs(np.diff(stops)).max() < 0.1
    assert np.allclose(gains[:, 0] + gains[:, 2], 2 * gains[:, 1])


def test_flicker_and_vignette_shape() -> None:
    flat = np.ones((41, 61, 3))
    lamp, lens = Effects(flicker=ALL["flicker"]).flicker, Effects(vignette={"strength": 0.6}).vignette
    assert lamp is not None
    assert lens is not None
    bands = effects.flicker(lamp, flat, 0)[:, 0, 0]
    assert np.allclose(bands, 1 + 0.2 * np.sin(2 * np.pi * np.arange(41) / 20))
    assert not np.allclose(effects.flicker(lamp, flat, 1)[:, 0, 0], bands), "the bands roll"
    vignetted = effects.vignette(lens, flat)
    assert vignetted[20, 30, 0] == 1.0
    assert vignetted[0, 0, 0] == pytest.approx(0.4)


def test_the_right_eye_has_the_effects_of_the_left_and_noise_of_its_own() -> None:
    """Before a wall of one colour both see the same light, through the same air, at the same exposure."""
    listed = {name: ALL[name] for name in ("fog", "exposure", "noise")}
    keys = [{"time": 0, "eye": [0, -4, 1.5], "target": [0, 0, 1.5]}]
    camera = {"keys": keys, "baseline": 0.01}
    scene = Scene(description="", frames=4, width=96, height=48, camera=camera, objects=OBJECTS, effects=listed)
    left = frames.set_stage(scene, seed=0)
    right, now = frames.right_eye(left, left.moment(1))
    images = []
    for stage, moment in ((left, left.moment(1)), (right, now)):
        seen = frames.see(stage, moment)
        clean = frames.develop(stage, moment, seen, with_effects=False)
        images.append(frames.final(stage, 1, moment, seen, clean))
    assert right.view(1).centre[0] == pytest.approx(left.view(1).centre[0] + 0.01)
    difference = images[1] - images[0]
    noise = np.sqrt(np.mean(np.maximum(images[0], 0) / 1000 + 0.01**2))
    assert np.abs(difference.mean(axis=(0, 1))).max() < 0.2 * noise
    assert np.median(np.abs(difference)) == pytest.approx(0.6745 * np.sqrt(2) * noise, rel=0.2)
