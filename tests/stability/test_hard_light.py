"""Light that hides what it would be measured on: clipped and black frames, grey channels, fog that hides everything."""

from dataclasses import replace

import finished_run as clip
import numpy as np
import pytest
from lit_room import drift, lit_room, tint
from square_inputs import observe
from test_scene_light import decided
from test_view_dependence import smooth_pictures

from stages.scene import rules
from stages.scene.light import MOST_LOG_GAIN, fit
from stages.scene.light_model import Model, no_light
from stages.scene.photometry import light_evidence, view_evidence
from stages.scene.sightings import Sightings, sight


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_gains_of_clipped_frames_are_not_observable(level: float) -> None:
    """Black or white frames: nothing is decided, nothing is infinite, and the reason says so."""
    seen = lit_room()
    seen.rgb[:] = level
    points = sight(seen)
    evidence, view = light_evidence(points), view_evidence(points, light_evidence(points).fitted)
    for decision in (
        rules.decide_exposure(evidence, "auto"),
        rules.decide_white_balance(evidence, "auto"),
        rules.decide_atmosphere(evidence, "auto"),
        rules.decide_view_dependent(view, "auto"),
    ):
        assert not decision["needed"]
        assert np.isfinite([decision["statistic"], *decision["interval"], *decision["evidence"].values()]).all()
    assert "not observable" in rules.decide_exposure(evidence, "auto")["why"]


def test_clipped_pixels_do_not_pull_a_gain() -> None:
    """Half of the picture is saturated in half of the frames: the other pixels tell the gain."""
    seen = lit_room(gains=drift(15.0))
    seen.rgb[4:, :, 80:] = 1.0
    evidence = light_evidence(sight(seen))
    assert decided(evidence) == (True, False, False)
    assert np.ptp(evidence.fitted.log_gains.mean(axis=1)) == pytest.approx(np.log(1.15), abs=0.01)


def test_one_frame_that_shows_nothing_keeps_the_gain_of_the_others() -> None:
    seen = lit_room(gains=drift(15.0))
    seen.rgb[3] = 0.0
    gains = light_evidence(sight(seen)).fitted.log_gains[:, 0]
    assert gains[-1] - gains[0] == pytest.approx(np.log(1.15), abs=0.01)
    assert np.isfinite(gains).all()


def test_grey_frames_have_no_white_balance() -> None:
    """All channels are one: a gain per channel saves nothing over one for all."""
    evidence = light_evidence(sight(lit_room(gains=drift(15.0), grey=True)))
    assert decided(evidence) == (True, False, False)
    assert abs(evidence.white_balance.size) < 0.1


def test_fog_before_a_camera_that_only_turns_is_not_observable() -> None:
    """No distance changes: any fog is part of the colours, and where it is asked for nothing drifts."""
    seen = lit_room(extinction=0.4)
    still = np.repeat(seen.cam_from_world[:1], len(seen.cam_from_world), axis=0)
    same = replace(seen, rgb=np.repeat(seen.rgb[:1], len(seen.rgb), axis=0), cam_from_world=still)
    same = replace(same, depth=np.repeat(seen.depth[:1], len(seen.depth), axis=0))
    found = rules.decide_atmosphere(light_evidence(sight(same)), "auto")
    assert not found["needed"]
    assert "not observable" in found["why"]
    assert found["extinction"] == 0
    forced = rules.decide_atmosphere(light_evidence(sight(same), foggy=True), "yes")
    assert (forced["needed"], forced["extinction"]) == (False, 0)
    assert "not observable" in forced["why"]
    assert "no fog is fitted" in forced["why"]


def test_fog_that_hides_everything_is_no_gain_and_no_gloss() -> None:
    """No texture shows through: the fog is not observable, and what stays the same is called that."""
    points = sight(lit_room(extinction=5.0))
    evidence = light_evidence(points)
    assert decided(evidence) == (False, False, False)
    view = rules.decide_view_dependent(view_evidence(points, evidence.fitted), "auto")
    assert not view["needed"]
    tinted = light_evidence(sight(lit_room(extinction=5.0, gains=drift(10.0) * tint(0.1))))
    assert decided(tinted) == (True, True, False)  # gains are seen on the fog itself


def test_a_highlight_that_is_seen_from_one_place_is_not_observable() -> None:
    """A camera that only trembles, under light that goes with it: time and view cannot be told apart."""
    points = sight(observe(smooth_pictures(shine=0.5)), textured=True)
    middle = points.centres.mean(axis=0)
    trembling = points._replace(centres=middle + 0.01 * (points.centres - middle))
    one_frame = points._replace(usable=points.usable & (np.arange(clip.T) == 0)[:, None])
    for seen, expected in ((points, True), (trembling, False), (one_frame, False)):
        found = rules.decide_view_dependent(view_evidence(seen, no_light(clip.T)), "auto")
        assert found["needed"] == expected
        assert ("not observable" in found["why"]) == (not expected)


@pytest.mark.parametrize(("seed", "count"), [(23, 5), (42, 7)])
def test_gains_of_a_few_points_of_noise_stay_within_what_eight_bits_show(seed: int, count: int) -> None:
    """Vignetting and gains grow against each other, in pure noise until the colours to explain overflow."""
    rng, seen = np.random.default_rng(seed), sight(lit_room())
    assert int(rng.integers(4, 40)) == count
    chosen, F = np.sort(rng.choice(len(seen.colours), count, replace=False)), seen.colours.shape[1]
    noise = Sightings(*(of[chosen] if len(of) == len(seen.colours) else of for of in seen))
    noise = noise._replace(
        colours=rng.random((count, F, 3)).astype(np.float32) ** 3,
        usable=noise.usable & (rng.random((count, F, 1)) < 0.5),
    )
    for gains in (1, 3):
        light = fit(noise, Model(gains, fog=False), np.ones(count, bool), no_light(F))
        assert max(np.abs(light.log_gains).max(), abs(light.vignetting)) <= MOST_LOG_GAIN
