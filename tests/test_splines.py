"""Values at the training frames, looked up between them: right, and at a cost that long clips can pay."""

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline

from stages.deformation import splines


def test_the_spline_through_the_same_knots_is_solved_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """It costs the square of the number of frames, and training asks for it several times a step."""
    solved = []

    def counted(x: np.ndarray, y: np.ndarray, **how: str) -> CubicSpline:
        solved.append(len(x))
        return CubicSpline(x, y, **how)

    monkeypatch.setattr(splines, "CubicSpline", counted)
    values = np.random.default_rng(0).normal(size=(23, 3))
    knots = np.sort(np.random.default_rng(1).random(23))
    for count, scale in ((1, 1.0), (2, 0.5)):  # other knots of the same number have a spline of their own
        oracle = CubicSpline(scale * knots, values, bc_type="natural")
        for time in scale * np.linspace(knots[0], knots[-1], 7):
            basis = splines.spline_basis(torch.tensor(scale * knots), np.array([time]))
            assert np.allclose(basis.numpy()[0] @ values, oracle(time))
        assert solved == [23] * count


def test_values_between_frames_lie_on_lines_and_stay_beyond_the_ends() -> None:
    knots, values = np.array([0.1, 0.2, 0.5, 0.9]), np.array([3.0, -1, 4, 2])
    for time in (-1.0, 0.0, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 0.9, 1.0):
        basis = splines.linear_basis(torch.tensor(knots), time).numpy()
        assert np.isclose(basis @ values, np.interp(time, knots, values))
        assert np.count_nonzero(basis) <= 2
