"""The steps of the fit of light: derivatives against finite differences, and weights that have all but vanished."""

from dataclasses import replace

import numpy as np
import pytest

from stages.scene import light, light_model, light_system
from stages.scene.light_model import Light, Model, Points, State
from stages.scene.sightings import Sightings


def points() -> Points:
    """Twelve points in six frames, at 2 to 9 scene units."""
    rng = np.random.default_rng(0)
    n, F = 12, 6
    colours, distance = rng.uniform(0.2, 0.8, (n, F, 3)), rng.uniform(2, 9, (n, F))
    off_axis, half = rng.uniform(0, 1, (n, F)), np.arange(n) % 2 == 0
    seen = Sightings(colours, colours > 0, distance, off_axis, np.arange(n), half, np.zeros((n, 3)), np.zeros((F, 3)))
    return Points(seen, np.ones(n, bool))


@pytest.mark.parametrize("extinction", [3e-4, 0.05, 0.4])
def test_derivatives_of_light_are_those_of_its_errors(extinction: float) -> None:
    """By vignetting, extinction and the three airlights, per median distance; and by the log radiance."""
    of, rng = points(), np.random.default_rng(1)
    fog = np.array([0.5, 0.6, 0.7])
    state = State(Light(np.zeros((6, 3)), 0.1, extinction / of.unit, fog / of.unit), rng.uniform(0.1, 0.6, (12, 3)))

    def moved(k: int, step: float) -> State:
        by = state.light
        by = replace(
            by, vignetting=by.vignetting + step * (k == 0), extinction=by.extinction + step * (k == 1) / of.unit
        )
        by = replace(by, scattered=by.scattered + step * (np.arange(2, 5) == k) / of.unit)
        return State(by, state.radiance * np.exp(step * (k == 5)))

    h = 0.3 * min(extinction, 0.01)
    analytic = [*light_model.derivatives(of, Model(0, True), state), light_model.slopes_of(of, state)]
    for k, found in enumerate(analytic):
        ahead, behind = (light_model.errors_of(of, moved(k, step)) for step in (h, -h))
        expected = (behind - ahead) / (2 * h)  # errors are what is left after the prediction
        np.testing.assert_allclose(found, expected, atol=2e-3, err_msg=f"parameter {k}")


def test_a_sample_of_nearly_no_weight_does_not_spoil_the_gains() -> None:
    """The inverse of its weight, a denormal number, is infinite in float32."""
    of, rng = points(), np.random.default_rng(0)
    weight = np.ones(of.colours.shape, np.float32)
    slope, error = (rng.standard_normal(weight.shape).astype(np.float32) for _ in range(2))
    weight[0] = 1e-40
    assert np.isfinite(
        light_system.normal_step(of, (weight, slope, error), [np.ones_like(error)], 1, (1e-3, 0.0))
    ).all()


@pytest.mark.parametrize("gains", [1, 3])
def test_frames_of_a_long_clip_are_solved_as_a_sparse_system(gains: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Points that are seen in a fifth of the frames: the true light is found, and the dense equations find the same."""
    rng = np.random.default_rng(0)
    n, F, span = 120, 50, 10
    first = rng.integers(0, F - span + 1, (n, 1))
    usable = (np.arange(F) >= first) & (np.arange(F) < first + span) & (rng.random((n, F)) < 0.9)
    distance, off_axis = 2 + 0.3 * (np.arange(F) - first) + rng.uniform(0, 1, (n, 1)), rng.uniform(0, 1, (n, F))
    drift = 0.2 * np.sin(np.arange(F)[:, None] / 4 + np.arange(gains)) * np.ones((1, 3))
    drift -= drift.mean(axis=0)
    state = State(Light(drift, -0.2, 0.05, np.full(3, 0.03)), rng.uniform(0.1, 0.6, (n, 3)))
    seen = Sightings(
        np.ones((n, F, 3)), np.repeat(usable[..., None], 3, axis=2), distance, off_axis, np.arange(n),
        np.arange(n) % 2 == 0, np.zeros((n, 3)), np.zeros((F, 3))
    )  # fmt: skip
    of = Points(seen, np.ones(n, bool))
    assert of.sparse
    assert of.frame.shape == (n, span)
    seen = seen._replace(colours=of.spread(np.exp(-light_model.errors_of(of, state))))

    def fitted() -> tuple[Light, np.ndarray]:
        rows, start = np.ones(n, bool), light_model.no_light(F)
        found = light.fit(seen, Model(gains, True), rows, light.fit(seen, Model(gains, False), rows, start))
        return found, light.residuals(seen, found, rows)

    found, left = fitted()
    monkeypatch.setattr(light_model, "SELDOM", 0.0)
    expected, expected_left = fitted()
    np.testing.assert_allclose(found.log_gains, expected.log_gains, atol=1e-5)
    np.testing.assert_allclose(left, expected_left, atol=1e-5)
    assert found.extinction == pytest.approx(expected.extinction, rel=1e-4)
    np.testing.assert_allclose(found.log_gains, drift, atol=0.02)
    assert found.vignetting == pytest.approx(-0.2, abs=0.02)
    assert np.abs(left).max() < 0.01
