"""Colour of the static scene that changes over time, as where shadows of movers pass over it."""

import math

import numpy as np
import torch
from torch import Tensor

from stages.deformation.lbs import neighbours
from stages.splatting import shadow_kernels
from stages.splatting.colours import ColourTable

FADED = 2.0
"""Kernel radii from a point at which its change has faded out."""
LEAST = math.exp(-(FADED**2) / 2)
"""The kernel there, and the weight of what does not change."""
REACH = 3.0
"""Kernel radii within which a Gaussian may come nearer while it is trained."""
NEIGHBOURS = 8
"""Points that blend; on a surface no more are within FADED radii, so that none comes or goes at once."""


class ShadowTable(ColourTable):
    """Colour offsets of S points at rest per training frame, which the static Gaussians around them blend.

    Attributes:
        knots, table: as of `ColourTable`, of these points. points: [S, 3] scene units. radii: [S] of their kernels.
        rows: [B] ascending indices of the static Gaussians within REACH radii of a point. index: [B, K], of the points
            nearest to each.
    """

    points: Tensor
    radii: Tensor
    rows: Tensor
    index: Tensor

    def __init__(self, knots: Tensor, points: Tensor, radii: Tensor) -> None:
        super().__init__(knots, len(points))
        self.register_buffer("points", points)
        self.register_buffer("radii", radii)
        self.bind(torch.zeros(0, 3))

    @torch.no_grad()
    def bind(self, means: Tensor) -> None:
        """Find the points nearest to the static Gaussians at means [n, 3]."""
        index, sq_dist = neighbours(self.points, means, NEIGHBOURS)
        rows = torch.nonzero(sq_dist[:, 0] < (REACH * self.radii[index[:, 0]]).square())[:, 0]
        for name, value in (("rows", rows), ("index", index[rows])):
            self.register_buffer(name, value, persistent=False)  # found again from the means

    @torch.no_grad()
    def weights(self, means: Tensor) -> Tensor:
        """Weights [B, K] at the present means [n, 3]; rows sum to less than one, the less the farther all points are.

        They have no gradient to the means: otherwise Gaussians would move in order to change their light.
        """
        if means.device.type != "cpu":
            return self.weights_torch(means)
        halves = 0.5 / self.radii.square()
        rows, index, points = self.rows.numpy(), self.index.numpy(), self.points.numpy()
        given = means.numpy(), rows, points, halves.numpy(), index, np.float32(LEAST)
        return torch.from_numpy(shadow_kernels.faded_weights(*given))

    @torch.no_grad()
    def weights_torch(self, means: Tensor) -> Tensor:
        """`weights` by torch's operations: for accelerators, and the oracle of the kernel."""
        sq_dist = (means[self.rows][:, None] - self.points[self.index]).square().sum(dim=-1)
        kernel = (torch.exp(-0.5 * sq_dist / self.radii[self.index].square()) - LEAST).clamp_min(0)
        return kernel / (kernel.sum(dim=1, keepdim=True) + LEAST)

    def of_static(self, means: Tensor, time: float) -> Tensor:
        """Offsets [B, 3] at `time` 0..1 of the static Gaussians `rows` of means [n, 3]."""
        return self(time, self.weights(means), self.index)

    def added(self, sh_dc: Tensor, means: Tensor, time: float) -> Tensor:
        """Constant SH coefficients [M, 1, 3] with these offsets; static Gaussians, at means [n, 3], come first."""
        return sh_dc.index_add(0, self.rows, self.of_static(means, time)[:, None])
