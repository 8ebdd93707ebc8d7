"""SO(3) and SE(3) where naive formulas lose digits: near zero, near half a turn, and at the sign of quaternions."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import expm

from stages.shared import lie

ANGLES = [0.0, 1e-300, 1e-12, 1e-8, 1e-4, 0.0099, 0.0101, 0.099, 0.101, 1.0, 3.0, np.pi - 1e-3]
AXIS = np.array([2.0, -1.0, 2.0]) / 3
RHO = np.array([0.3, -2.0, 0.7])


def hat(xi: np.ndarray) -> np.ndarray:
    """The 4 x 4 generator of a twist."""
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = lie.skew(xi[3:]), xi[:3]
    return generator


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_equals_the_matrix_exponential(angle: float) -> None:
    xi = np.concatenate([RHO, angle * AXIS])
    assert_allclose(lie.exp_se3(xi), expm(hat(xi)), atol=1e-13)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_inverts_exp(angle: float) -> None:
    xi = np.concatenate([RHO, angle * AXIS])
    assert_allclose(lie.log_se3(lie.exp_se3(xi)), xi, atol=1e-11)


@pytest.mark.parametrize("angle", [1e-4, 1e-5, 1e-6])
def test_the_series_keeps_the_digits_that_the_closed_form_loses(angle: float) -> None:
    exact = 1 / 6 - angle**2 / 120
    naive = (angle - np.sin(angle)) / angle**3
    assert abs(naive - exact) > 1e-10
    # The second-order term of V moves a point that is 1e8 away by c |w|^2 1e8: its error would show.
    xi = np.array([1e8, 0, 0, 0, angle, 0])
    assert lie.exp_se3(xi)[0, 3] == pytest.approx(1e8 * np.sin(angle) / angle, rel=1e-15)


@pytest.mark.parametrize("gap", [0.0, 1e-14, 1e-10, 1e-7])
@pytest.mark.parametrize("axis", [np.eye(3)[0], np.eye(3)[1], np.eye(3)[2], AXIS])
def test_log_at_half_a_turn_finds_the_axis(gap: float, axis: np.ndarray) -> None:
    R = lie.exp_so3((np.pi - gap) * axis)
    omega = lie.log_so3(R)
    # The antisymmetric part, on which the naive form rests, has vanished.
    assert np.abs(R - R.T).max() < 1e-6
    assert np.linalg.norm(omega) == pytest.approx(np.pi - gap, abs=1e-7)
    assert abs(omega @ axis) == pytest.approx(np.pi, abs=1e-6)
    assert_allclose(lie.exp_so3(omega), R, atol=1e-7)


def test_log_does_not_leave_the_domain_of_arccos() -> None:
    R = np.eye(3) * (1 + 1e-15)
    with np.errstate(invalid="ignore"):
        assert np.isnan(np.arccos((np.trace(R) - 1) / 2))
    assert_allclose(lie.log_so3(R), 0, atol=1e-12)


def test_exp_and_adjoint_agree() -> None:
    rng = np.random.default_rng(0)
    T, xi = lie.exp_se3(rng.normal(size=6)), rng.normal(size=6)
    assert_allclose(T @ lie.exp_se3(xi) @ lie.inverse(T), lie.exp_se3(lie.adjoint(T) @ xi), atol=1e-12)


def test_inverse_of_a_far_camera_keeps_its_digits() -> None:
    T = lie.exp_se3(np.array([1e8, -2e8, 3e8, 0.1, 2.0, -0.3]))
    assert_allclose(lie.inverse(T)[:3, :3], np.linalg.inv(T)[:3, :3], atol=1e-13)
    assert_allclose(lie.inverse(lie.inverse(T)), T, rtol=1e-14)


def test_opposite_quaternions_are_one_rotation_with_a_canonical_sign() -> None:
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(100, 4))
    R = lie.matrix_from_quat(quats)
    assert_allclose(lie.matrix_from_quat(-quats), R, atol=1e-14)
    recovered = lie.quat_from_matrix(R)
    assert (recovered[:, 0] >= 0).all()
    assert_allclose(np.abs((recovered * quats).sum(axis=1)), np.linalg.norm(quats, axis=1), rtol=1e-12)


def test_quaternions_near_zero_are_normalised_and_zero_is_refused() -> None:
    q = np.array([0.5, -0.5, 0.5, 0.5])
    assert_allclose(lie.matrix_from_quat(1e-150 * q), lie.matrix_from_quat(q), atol=1e-14)
    with pytest.raises(ValueError, match="zero"):
        lie.matrix_from_quat(np.zeros(4))


def test_empty_batches_pass_through() -> None:
    assert lie.exp_se3(np.zeros((0, 6))).shape == (0, 4, 4)
    assert lie.log_se3(np.zeros((0, 4, 4))).shape == (0, 6)
    assert lie.adjoint(np.zeros((0, 4, 4))).shape == (0, 6, 6)


def test_cross_products_are_those_of_numpy() -> None:
    random = np.random.default_rng(0)
    a, b = random.standard_normal((4, 1, 3)), random.standard_normal((5, 3))
    assert_allclose(lie.cross(a, b), np.cross(a, b), rtol=1e-14)
    assert_allclose(lie.cross(a, b), np.einsum("...ij,...j->...i", lie.skew(a), b), rtol=1e-14)
