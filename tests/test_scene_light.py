"""Which changes of light are modelled: gains, white balance and fog, each beside the others, against truth."""

from dataclasses import replace

import numpy as np
import pytest
from lit_room import drift, lit_room, tint

from stages.scene import light, photometry, rules
from stages.scene.followed import followed_evidence
from stages.scene.light_model import Light, Model, cleared, no_light
from stages.scene.observed import Observed
from stages.scene.photometry import LightEvidence, light_evidence
from stages.scene.sightings import sight
from stages.shared.images import DISPLAY_GAMMA


def decided(evidence: LightEvidence) -> tuple[bool, bool, bool]:
    """Whether gains, gains per channel beside them, and fog buy enough."""
    parts = ((evidence.exposure, False), (evidence.white_balance, False), (evidence.atmosphere, True))
    exposure, white_balance, fog = (photometry.is_worth(bought, is_fog) for bought, is_fog in parts)
    return exposure, white_balance, fog


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


@pytest.mark.parametrize("everywhere", [True, False])
def test_a_gain_acts_on_the_whole_picture(everywhere: bool) -> None:
    """A surface that turns from the light darkens as by a gain: where all else moves, nothing static says otherwise."""
    changing = lit_room(gains=drift(15.0))
    moves = np.arange(changing.dynamic.shape[2]) >= 60
    rgb = changing.rgb if everywhere else np.where(moves[:, None], lit_room().rgb, changing.rgb)
    seen = replace(changing, rgb=rgb, dynamic=np.broadcast_to(moves, changing.dynamic.shape))
    evidence = light_evidence(sight(seen))
    found = rules.decide_exposure(evidence, "auto")
    assert found["needed"]
    gain, tint = followed_evidence(seen, evidence.fitted.log_gains)
    found |= rules.about_followed(found, gain)
    assert found["needed"] == everywhere
    assert ("whole picture" in found["why"]) != everywhere
    assert tint.size == pytest.approx(0, abs=0.1)
    assert not rules.about_followed(rules.decide_exposure(evidence, "yes"), gain)  # the user knows better


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
