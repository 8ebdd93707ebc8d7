"""Umeyama alignment where the naive form breaks: tiny, huge, flat, mirrored and degenerate point sets."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.shared.alignment import DegenerateError, extent, umeyama

R = Rotation.from_rotvec([0.3, -1.1, 2.0]).as_matrix()
t = np.array([4.0, -2.0, 0.5])


def _points(T: int = 20) -> np.ndarray:
    return np.random.default_rng(3).normal(size=(T, 3))


@pytest.mark.parametrize("size", [1e-100, 1e-8, 1e-4, 1.0, 1e4, 1e100])
def test_recovers_a_similarity_at_any_scale(size: float) -> None:
    """An absolute rank test calls the small scenes degenerate."""
    source = _points() * size
    scale, found_R, found_t = umeyama(source, 2.5 * source @ R.T + size * t)
    assert scale == pytest.approx(2.5, rel=1e-12)
    np.testing.assert_allclose(found_R, R, atol=1e-12)
    np.testing.assert_allclose(found_t, size * t, rtol=1e-10)


def test_planar_points_have_a_unique_similarity() -> None:
    source = _points() * [1, 1, 0]
    scale, found_R, _ = umeyama(source, 0.5 * source @ R.T + t)
    assert scale == pytest.approx(0.5, rel=1e-12)
    np.testing.assert_allclose(found_R, R, atol=1e-12)


def test_a_mirrored_target_never_gives_a_reflection() -> None:
    source = _points()
    _, found_R, _ = umeyama(source, source * [1, 1, -1])
    assert np.linalg.det(found_R) == pytest.approx(1.0, abs=1e-12)


def test_the_result_is_a_minimum() -> None:
    """No small change of scale, rotation or translation lowers the squared error of noisy points."""
    rng = np.random.default_rng(5)
    source = _points()
    target = 1.7 * source @ R.T + t + 0.2 * rng.normal(size=source.shape)
    scale, found_R, found_t = umeyama(source, target)

    def cost(ds: float, dR: np.ndarray, dt: np.ndarray) -> float:
        turned = Rotation.from_rotvec(dR).as_matrix() @ found_R
        return float(((target - ((scale + ds) * source @ turned.T + found_t + dt)) ** 2).sum())

    best = cost(0.0, np.zeros(3), np.zeros(3))
    for _ in range(50):
        ds, dR, dt = 1e-3 * rng.normal(), 1e-3 * rng.normal(size=3), 1e-3 * rng.normal(size=3)
        assert cost(ds, dR, dt) > best


@pytest.mark.parametrize(
    ("points", "shape"),
    [
        (np.full((5, 3), 0.1), "point"),
        (np.full((5, 3), 1e6) + 1e-10, "point"),
        (np.ones((1, 3)), "point"),
        (np.arange(6.0).reshape(2, 3), "line"),
        (np.outer(np.linspace(0, 1, 7), [1.0, 2.0, 3.0]) + 1e6, "line"),
        (_points() * 1e-9, "volume"),
    ],
)
def test_extent_is_told_apart_from_rounding(points: np.ndarray, shape: str) -> None:
    assert extent(points) == shape


def test_degenerate_sets_are_named() -> None:
    line, cloud = np.outer(np.arange(9.0), [1.0, 2.0, 3.0]), _points(9)
    for source, target, which, shape in [
        (cloud, line, "target", "line"),
        (line, cloud, "source", "line"),
        (np.zeros((9, 3)), cloud, "source", "point"),
    ]:
        with pytest.raises(DegenerateError) as caught:
            umeyama(source, target)
        assert (caught.value.which, caught.value.shape) == (which, shape)


def test_uncorrelated_sets_are_degenerate_together() -> None:
    """Each square is a plane, but one's second axis says nothing about the other's."""
    source = np.array([[1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0.0]])
    target = np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0.0]])
    with pytest.raises(DegenerateError) as caught:
        umeyama(source, target)
    assert caught.value.which == "both"


def test_wrong_shapes_and_values_are_refused() -> None:
    with pytest.raises(ValueError, match=r"two arrays \[T, 3\]"):
        umeyama(_points(4), _points(5))
    with pytest.raises(ValueError, match="finite"):
        umeyama(np.full((4, 3), np.nan), _points(4))
