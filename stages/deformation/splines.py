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
            return torch.einsum("bf,fpc->bpc", basis, table)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, Tensor]:
        with one_torch_thread():
            return None, torch.einsum("bf,bpc->fpc", *ctx.saved_tensors, gradients[0])


def spline_basis(knots: Tensor, times: np.ndarray) -> Tensor:
    """Weights [B, F] of the values at F >= 2 ascending knots in a natural cubic spline at times [B].

    Times before the first and after the last knot take its value.
    """
    ascending = knots.cpu().numpy().astype(float)
    inside = np.clip(times.astype(float), ascending[0], ascending[-1])
    return torch.as_tensor(_cardinal(ascending.tobytes())(inside))


@lru_cache(HELD)
def _cardinal(knots: bytes) -> CubicSpline:
    """The spline through each knot in turn, of knots as float64: its cost grows with the square of their number."""
    ascending = np.frombuffer(knots)
    return CubicSpline(ascending, np.eye(len(ascending)), bc_type="natural")


def linear_basis(knots: Tensor, time: float) -> Tensor:
    """Weights [F], float64, of the values at F >= 2 ascending knots at `time`: of `np.interp`, two of them at most."""
    ascending = knots.cpu().numpy().astype(float)
    before = min(max(int(np.searchsorted(ascending, time, side="right")) - 1, 0), len(ascending) - 2)
    ends = slice(before, before + 2)
    weights = np.zeros(len(ascending))
    weights[ends] = [np.interp(time, ascending[ends], of_one) for of_one in np.eye(2)]
    return torch.as_tensor(weights)
