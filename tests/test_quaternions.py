"""The three forms of a quaternion, numpy for poses, torch and kernels for Gaussians, against scipy and each other."""

import numpy as np
import pytest
import torch
from numba import njit
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from stages.shared import lie, quaternion_kernels, quaternions

TURNS = Rotation.random(50, random_state=0)
QUATS = TURNS.as_quat(scalar_first=True)


@njit
def kernel_rotation(quats: np.ndarray, n: int) -> quaternion_kernels.Rows:
    return quaternion_kernels.rotation(quaternion_kernels.row(quats, n))


@njit
def kernel_product(left: np.ndarray, right: np.ndarray, n: int) -> quaternion_kernels.Quaternion:
    return quaternion_kernels.product(quaternion_kernels.row(left, n), quaternion_kernels.row(right, n))


@njit
def kernel_rotation_adjoint(quats: np.ndarray, n: int, g: quaternion_kernels.Rows) -> quaternion_kernels.Quaternion:
    return quaternion_kernels.rotation_adjoint(quaternion_kernels.row(quats, n), g)


def test_matrices_equal_scipy() -> None:
    expected = TURNS.as_matrix()
    assert_allclose(lie.matrix_from_quat(QUATS), expected, atol=1e-14)
    assert_allclose(quaternions.rotation_matrices(torch.from_numpy(QUATS)).numpy(), expected, atol=1e-14)
    assert_allclose([kernel_rotation(QUATS, n) for n in range(len(QUATS))], expected, atol=1e-14)


def test_quaternions_and_vectors_of_matrices_equal_scipy() -> None:
    R = TURNS.as_matrix()
    assert_allclose(lie.quat_from_matrix(R), TURNS.as_quat(canonical=True, scalar_first=True), atol=1e-14)
    assert_allclose(lie.log_so3(R), TURNS.as_rotvec(), atol=1e-13)
    assert_allclose(lie.exp_so3(TURNS.as_rotvec()), R, atol=1e-14)


def test_products_equal_scipy() -> None:
    other = Rotation.random(50, random_state=1)
    left, right = QUATS, other.as_quat(scalar_first=True)
    expected = (TURNS * other).as_matrix()
    for product in (
        quaternions.multiply(torch.from_numpy(left), torch.from_numpy(right)).numpy(),
        np.array([kernel_product(left, right, n) for n in range(len(left))]),
    ):
        assert_allclose(Rotation.from_quat(product, scalar_first=True).as_matrix(), expected, atol=1e-14)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_the_adjoint_of_the_matrix_equals_autograd(kind: type[np.floating]) -> None:
    quats = QUATS.astype(kind)
    g = np.random.default_rng(0).normal(size=(3, 3)).astype(kind)
    leaf = torch.from_numpy(quats).requires_grad_()
    (quaternions.rotation_matrices(leaf) * torch.from_numpy(g)).sum().backward()
    rows = tuple(map(tuple, g))
    found = [kernel_rotation_adjoint(quats, n, rows) for n in range(len(quats))]
    assert leaf.grad is not None
    assert_allclose(found, leaf.grad.numpy(), atol=1e-5 if kind == np.float32 else 1e-13)
