"""Exposure and white balance: gains per training frame, for scenes whose brightness or tint changes."""

import torch
from torch import Tensor

from stages.deformation.splines import linear_basis


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
