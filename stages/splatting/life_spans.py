"""Life spans of Gaussians: the opacity of each falls off with the time from the frame that it was lifted from.

One cloud for all time must be right in every frame through the motion of the control points, and blurs where that is
off by half a pixel. With life spans each Gaussian answers for the frames around its own, as the temporal opacity of
Spacetime Gaussians does (Li et al., CVPR 2024).
"""

import math
from typing import Any

import torch
from torch import Tensor

ALWAYS = 10.0
"""Logarithm of a span, in lengths of the clip, at which opacity is constant in single precision."""

REACH = math.sqrt(2 * math.log(255))
"""Spans from the birth at which even an opaque Gaussian is too transparent to be drawn, below alpha 1/255."""


def presence(births: Tensor, log_spans: Tensor, time: float) -> Tensor:
    """Factors [N] in 0..1 of the opacities at `time`: exp(-(time - birth)^2 / (2 span^2)).

    Args:
        births: [N] times of largest opacity. log_spans: [N] logarithms of the spans. The clip lasts from 0 to 1.
    """
    return torch.exp(-0.5 * ((time - births) * torch.exp(-log_spans)).square())


def rows_of(values: Tensor, rows: Tensor | None) -> Tensor:
    """The rows [M] of values [N, ...], each at most once; all of them if `rows` is None."""
    if rows is None:
        return values
    taken: Tensor = _Rows.apply(values, rows)  # type: ignore[no-untyped-call]
    return taken


class _Rows(torch.autograd.Function):
    """A gather whose gradient is copied back: torch's own adds it up row by row, in case a row was taken twice."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, rows: Tensor) -> Tensor:
        ctx.shape = values.shape
        ctx.save_for_backward(rows)
        return values.index_select(0, rows)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (gradient,), (rows,) = gradients, ctx.saved_tensors
        return gradient.new_zeros(ctx.shape).index_copy_(0, rows, gradient), None
