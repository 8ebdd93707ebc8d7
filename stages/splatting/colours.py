"""Colour that changes over time: shading changes on moving surfaces, which a constant colour cannot represent."""

import numpy as np
import torch
from torch import Tensor

from stages.deformation.lbs import blend_values
from stages.deformation.splines import at_times, spline_basis


class ColourTable(torch.nn.Module):
    """A colour offset per control point and training frame; Gaussians blend offsets with their skinning weights.

    Attributes:
        knots: [F] ascending times in 0..1, F >= 2. table: [F, P, 3] offsets of the constant SH coefficient, trained.
    """

    knots: Tensor

    def __init__(self, knots: Tensor, P: int) -> None:
        super().__init__()
        self.register_buffer("knots", knots.to(torch.float64))
        self.table = torch.nn.Parameter(torch.zeros(len(knots), P, 3))

    def forward(self, time: float, weights: Tensor, index: Tensor) -> Tensor:
        """Offsets [N, 3] at `time` 0..1, by a natural cubic spline between the frames.

        Args:
            weights: [N, K] skinning weights; they get no gradient, so that colours do not change the kernel radii.
            index: [N, K] indices of control points.
        """
        return blend_values(self.of_points(time), weights, index)

    def of_points(self, time: float) -> Tensor:
        """Offsets [P, 3] of the control points at `time` 0..1."""
        return at_times(spline_basis(self.knots, np.array([time])), self.table)[0]
