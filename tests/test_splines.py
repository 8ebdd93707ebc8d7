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
    for time in (0.1, 0.2):
        splines.spline_basis(torch.tensor(knots), np.array([time]), left_out=11)
    assert solved[2:] == [2 * splines.NEAR]


@pytest.mark.parametrize("F", [3, 5, 40])
def test_a_knot_that_is_left_out_tells_nothing(F: int) -> None:
    """The spline goes through the others. Of a long clip those far away are left out too, for a small error."""
    knots = np.sort(np.random.default_rng(2).random(F)) + 0.05 * np.arange(F)
    values, k = np.random.default_rng(3).normal(size=(F, 2)), F // 2
    others = np.delete(np.arange(F), k)
    oracle = CubicSpline(knots[others], values[others], bc_type="natural")
    for time in (knots[k], 0.3 * knots[k - 1] + 0.7 * knots[k]):
        basis = splines.spline_basis(torch.tensor(knots), np.array([time]), left_out=k).numpy()[0]
        assert basis[k] == 0
        assert np.allclose(basis @ values, oracle(time), atol=1e-9 if F < 2 * splines.NEAR else 2e-3)


def test_both_ends_are_never_left_out() -> None:
    """Beyond the others nothing tells the motion: a spline would go on along a line."""
    knots = torch.tensor([0.0, 0.3, 0.6, 1.0], dtype=torch.float64)
    for end in (0, 3):
        basis = splines.spline_basis(knots, np.array([0.0, 0.2, 1.0]), left_out=end)
        assert torch.equal(basis, splines.spline_basis(knots, np.array([0.0, 0.2, 1.0])))


def test_values_between_frames_lie_on_lines_and_stay_beyond_the_ends() -> None:
    knots, values = np.array([0.1, 0.2, 0.5, 0.9]), np.array([3.0, -1, 4, 2])
    for time in (-1.0, 0.0, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 0.9, 1.0):
        basis = splines.linear_basis(torch.tensor(knots), time).numpy()
        assert np.isclose(basis @ values, np.interp(time, knots, values))
        assert np.count_nonzero(basis) <= 2
