"""The steps of the fit of light: derivatives against finite differences, and weights that have all but vanished."""

from dataclasses import replace

import numpy as np
import pytest

from stages.scene import light, light_model
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
    rng = np.random.default_rng(0)
    weight = np.ones((20, 4, 3), np.float32)
    slope, error = (rng.standard_normal(weight.shape).astype(np.float32) for _ in range(2))
    weight[0] = 1e-40
    assert np.isfinite(light._solve(weight, slope, error, [], 1, (1e-3, 0.0))).all()
