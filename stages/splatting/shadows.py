"""Colour of the static scene that changes over time, as where shadows of movers pass over it."""

import math

import torch
from torch import Tensor

from stages.deformation.lbs import neighbours
from stages.splatting.colours import ColourTable

FADED = 2.0
"""Kernel radii from a point at which its change has faded out."""
NEIGHBOURS = 4


class ShadowTable(ColourTable):
    """Colour offsets of S points at rest per training frame, which the static Gaussians around them blend.

    Attributes:
        knots, table: as of `ColourTable`, of these points. points: [S, 3] scene units. radii: [S] of their kernels.
        rows: [B] ascending indices of the static Gaussians within FADED radii of a point. index, weights: [B, K], of
            the points nearest to each; weights sum to less than one, the less the farther all points are.
    """

    points: Tensor
    radii: Tensor
    rows: Tensor
    index: Tensor
    weights: Tensor

    def __init__(self, knots: Tensor, points: Tensor, radii: Tensor) -> None:
        super().__init__(knots, len(points))
        self.register_buffer("points", points)
        self.register_buffer("radii", radii)
        self.bind(torch.zeros(0, 3))

    @torch.no_grad()
    def bind(self, means: Tensor) -> None:
        """Find the points nearest to the static Gaussians at means [n, 3]."""
        index, sq_dist = neighbours(self.points, means, NEIGHBOURS)
        exponents = sq_dist / (2 * self.radii[index].square())
        rows, least = torch.nonzero(exponents[:, 0] < FADED**2 / 2)[:, 0], math.exp(-(FADED**2) / 2)
        kernel = (torch.exp(-exponents[rows]) - least).clamp_min(0)
        weights = kernel / (kernel.sum(dim=1, keepdim=True) + least)
        for name, value in (("rows", rows), ("index", index[rows]), ("weights", weights)):
            self.register_buffer(name, value, persistent=False)  # found again from the means

    def added(self, sh_dc: Tensor, time: float) -> Tensor:
        """Constant SH coefficients [M, 1, 3] with these offsets at `time` 0..1; all static Gaussians come first."""
        return sh_dc.index_add(0, self.rows, self(time, self.weights, self.index)[:, None])
