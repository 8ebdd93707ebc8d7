"""Tables of values at knots, the training frames, looked up at any time: natural cubic splines, and lines."""

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from stages.shared.torch_threads import one_torch_thread

HELD = 2
"""Sets of knots whose splines are kept: 32 bytes for the square of their number. A model has one set."""
HELD_NEARBY = 1024
"""Of at most 2 NEAR knots each: 8 MB. A model has one for each frame, and training asks for them over and over."""
NEAR = 8
"""Knots on each side that count where one is left out: those beyond have a weight of less than 1e-4."""


def at_times(basis: Tensor, table: Tensor) -> Tensor:
    """Values [B, P, C] of a table [F, P, C] at knots, at the times whose weights `spline_basis` [B, F] gives."""
    values: Tensor = _AtTimes.apply(basis.to(table), table)  # type: ignore[no-untyped-call]
    return values


class _AtTimes(torch.autograd.Function):
    """On one thread also backwards: products of matrices of this shape round by the number of threads."""

    @staticmethod
    def forward(ctx: Any, basis: Tensor, table: Tensor) -> Tensor:
        ctx.save_for_backward(basis)
        with one_torch_thread():
            return (basis @ table.reshape(len(table), -1)).reshape(len(basis), *table.shape[1:])

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, Tensor]:
        with one_torch_thread():
            (basis,), (gradient,) = ctx.saved_tensors, gradients
            return None, (basis.T @ gradient.reshape(len(basis), -1)).reshape(-1, *gradient.shape[1:])


def spline_basis(knots: Tensor, times: np.ndarray, left_out: int | None = None) -> Tensor:
    """Weights [B, F] of the values at F >= 2 ascending knots in a natural cubic spline at times [B].

    Times before the first and after the last knot take its value.

    Args:
        left_out: a knot through whose value the spline does not go, for times around it; at both ends it always does.
    """
    ascending = knots.cpu().numpy().astype(float)
    if left_out is None or not 0 < left_out < len(ascending) - 1:
        inside = np.clip(times.astype(float), ascending[0], ascending[-1])
        return torch.as_tensor(_cardinal(ascending.tobytes())(inside))
    first = max(0, left_out - NEAR)
    others = np.delete(np.arange(first, min(len(ascending), left_out + NEAR + 1)), left_out - first)
    weights = np.zeros((len(times), len(ascending)))
    weights[:, others] = _nearby(ascending[others].tobytes())(times.astype(float))
    return torch.as_tensor(weights)


@lru_cache(HELD)
def _cardinal(knots: bytes) -> CubicSpline:
    """`_spline` of knots as float64: its cost grows with the square of their number."""
    return _spline(np.frombuffer(knots))


@lru_cache(HELD_NEARBY)
def _nearby(knots: bytes) -> CubicSpline:
    """The same of few knots: all but one around a knot."""
    return _spline(np.frombuffer(knots))


def _spline(knots: np.ndarray) -> CubicSpline:
    """The natural spline through each knot in turn."""
    return CubicSpline(knots, np.eye(len(knots)), bc_type="natural")


def linear_basis(knots: Tensor, time: float) -> Tensor:
    """Weights [F], float64, of the values at F >= 2 ascending knots at `time`: of `np.interp`, two of them at most."""
    ascending = knots.cpu().numpy().astype(float)
    before = min(max(int(np.searchsorted(ascending, time, side="right")) - 1, 0), len(ascending) - 2)
    ends = slice(before, before + 2)
    weights = np.zeros(len(ascending))
    weights[ends] = [np.interp(time, ascending[ends], of_one) for of_one in np.eye(2)]
    return torch.as_tensor(weights)
