"""The vector type of the raster kernels against numpy, lane by lane."""

from collections.abc import Callable

import numpy as np
import pytest
from numba import njit

from stages.shared.lanes import LANES, largest, load, store, totals, trailing_zeros, where

ZERO, ONE = np.float32(0), np.float32(1)


@njit
def arithmetic(a: np.ndarray, b: np.ndarray, out: np.ndarray) -> None:
    x, y = load(a, 0), load(b, LANES)
    store(out, 0, x + y)
    store(out, LANES, ONE - x * y)
    store(out, 2 * LANES, x / (y + ONE))
    store(out, 3 * LANES, where((x > y) & (x <= np.float32(0.8)), x, ZERO))
    store(out, 4 * LANES, where((x >= y) & (y < np.float32(0.3)), ZERO, y))


def test_lanes_act_like_rows_of_sixteen() -> None:
    random = np.random.default_rng(0)
    a, b = random.uniform(size=(2, 2 * LANES)).astype(np.float32)
    out = np.zeros((5, LANES), np.float32)
    arithmetic(a, b, out)
    x, y = a[:LANES], b[LANES:]
    masked = np.where((x > y) & (x <= np.float32(0.8)), x, 0)
    flags = (x >= y) & (y < np.float32(0.3))
    assert 0 < flags.sum() < LANES
    assert 0 < (masked > 0).sum() < LANES
    np.testing.assert_allclose(out, [x + y, 1 - x * y, x / (y + 1), masked, np.where(flags, 0, y)], rtol=1e-6)


@njit
def ten_totals(a: np.ndarray, out: np.ndarray) -> None:

    a0, a1, a2, a3, a4 = load(a, 0), load(a, 16), load(a, 32), load(a, 48), load(a, 64)
    a5, a6, a7, a8, a9 = load(a, 80), load(a, 96), load(a, 112), load(a, 128), load(a, 144)
    store(out, 0, totals((a0, a1, a2, a3, a4, a5, a6, a7, a8, a9)))


@njit
def one_total(a: np.ndarray, out: np.ndarray) -> None:
    store(out, 0, totals((load(a, 0),)))


@pytest.mark.parametrize(("function", "count"), [(ten_totals, 10), (one_total, 1)])
def test_totals_are_in_the_order_of_the_values(function: Callable[..., None], count: int) -> None:
    a, out = np.random.default_rng(1).normal(size=(count, LANES)).astype(np.float32), np.empty(LANES, np.float32)
    function(a, out)
    np.testing.assert_allclose(out[:count], a.sum(axis=1), rtol=1e-5, atol=1e-6)
    assert (out[count:] == 0).all()


@njit
def reductions(a: np.ndarray, bits: int) -> tuple[float, int]:
    return largest(load(a, 0)), trailing_zeros(bits)


def test_largest_lane_and_lowest_bit() -> None:
    a = -np.random.default_rng(2).uniform(size=LANES).astype(np.float32)
    assert reductions(a, 0b1011000) == (a.max(), 3)
