"""Small corrections of the estimated poses, optimised with the scene."""

import torch
from torch import Tensor

from stages.deformation.splines import linear_basis


class PoseTable(torch.nn.Module):
    """A twist per training frame, interpolated linearly over time: held-out frames and new views are corrected too.

    Attributes:
        knots: [F] ascending times in 0..1. twists: [F, 6], translation in units of `length` and rotation in radians.
        length: the median depth in scene units; it makes the twists independent of the scene unit.
    """

    knots: Tensor
    length: Tensor

    def __init__(self, knots: Tensor, length: float) -> None:
        super().__init__()
        self.register_buffer("knots", knots.to(torch.float64))
        self.register_buffer("length", torch.tensor(length))
        self.twists = torch.nn.Parameter(torch.zeros(len(knots), 6))

    def forward(self, time: float) -> Tensor:
        """Transform [4, 4] float64 from the estimated to the corrected camera at `time` 0..1: exp of the twist."""
        twist = linear_basis(self.knots, time).to(self.twists.device) @ self.twists.double()
        x, y, z = twist[3:]
        zero = torch.zeros_like(x)
        turn = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
        generator = torch.cat([turn, self.length * twist[:3, None]], dim=1)
        return torch.linalg.matrix_exp(torch.cat([generator, generator.new_zeros(1, 4)]))

    def size(self) -> Tensor:
        """Mean square of the twists (scalar), a penalty that keeps poses at their estimates if images do not decide."""
        return self.twists.square().mean()
