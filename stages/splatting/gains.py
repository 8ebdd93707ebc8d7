"""Exposure and white balance: gains per training frame, for scenes whose brightness or tint changes."""

from typing import Any

import torch
from torch import Tensor

from stages.deformation.splines import linear_basis
from stages.splatting import gain_kernels


class Exposure(torch.nn.Module):
    """Gains over time, linear between the training frames.

    Their mean logarithm over the frames is zero: otherwise a common factor of gains and colours would be undetermined.

    Attributes:
        knots: [F] ascending times in 0..1.
        log_gains: [F, 1] of all channels together, or [F, 3] of each; trained.
    """

    knots: Tensor

    def __init__(self, knots: Tensor, channels: int) -> None:
        super().__init__()
        self.register_buffer("knots", knots.to(torch.float64))
        self.log_gains = torch.nn.Parameter(torch.zeros(len(knots), channels))

    def forward(self, time: float) -> Tensor:
        """Gain [3] > 0 at `time` 0..1."""
        shares = linear_basis(self.knots, time)
        centred = self.log_gains - self.log_gains.mean(dim=0)
        return (shares.to(centred) @ centred).exp().expand(3)


def lit(colour: Tensor, gain: Tensor) -> Tensor:
    """Colours [..., W, 3] times the gain [3], differentiable in both."""
    if colour.device.type != "cpu":
        return colour * gain
    product: Tensor = _Lit.apply(colour, gain)  # type: ignore[no-untyped-call]
    return product


class _Lit(torch.autograd.Function):
    """The kernels of `gain_kernels`; the gain's gradient is summed row by row of the image."""

    @staticmethod
    def forward(ctx: Any, colour: Tensor, gain: Tensor) -> Tensor:
        ctx.saved = colour.detach().reshape(-1, 3).numpy(), gain.detach().contiguous().numpy(), colour.shape
        return torch.from_numpy(gain_kernels.lit(*ctx.saved[:2])).view(colour.shape)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        colour, gain, shape = ctx.saved
        g = gradients[0].reshape(-1, 3).numpy()
        g_colour, g_gain = gain_kernels.lit_adjoint(colour, gain, g, shape[-2])
        return torch.from_numpy(g_colour).view(shape), torch.from_numpy(g_gain)
