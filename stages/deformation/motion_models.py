"""Motion of the control points over time: two models behind one interface.

Both map times 0..1 to a rotation and a translation per control point, relative to the canonical frame.
"""

import abc
import itertools
import math

import torch
from torch import Tensor

from stages.deformation.arap import arap_energy, arap_graph
from stages.deformation.splines import at_times, spline_basis
from stages.shared import quaternions

LONG_KNOTS, LEAST_WEIGHT = 100, 1e-12
"""With more knots their own values are looked up; weights up to the least one are rounding of the spline."""


class Deformation(torch.nn.Module, abc.ABC):
    """Canonical control points with their motion.

    Attributes:
        points: [P, 3] float32, canonical positions in scene units (a buffer: they are not trained).
        log_radii: [P] logarithms of the kernel radii sigma_k in scene units, trained.
        graph_index, graph_weights: [P, K] which control points should turn together, as in `arap.arap_graph`.
        centre: their mean. extent: how far they reach, at most `max_extent`: the unit of the motion and of the
            optimiser's steps, which makes both independent of the scene's.
    """

    points: Tensor
    centre: Tensor
    extent: Tensor
    graph_index: Tensor
    graph_weights: Tensor

    def __init__(self, points: Tensor, log_radii: Tensor, max_extent: float = math.inf) -> None:
        super().__init__()
        centre = points.mean(0)
        self.register_buffer("points", points.clone())
        self.register_buffer("centre", centre)
        reach = (points - centre).abs().max().clamp_min(log_radii.exp().max())
        self.register_buffer("extent", reach.clamp_max(max_extent))
        for name, values in zip(("graph_index", "graph_weights"), arap_graph(points), strict=True):
            self.register_buffer(name, values, persistent=False)  # follows from the points
        self.log_radii = torch.nn.Parameter(log_radii.clone())

    @abc.abstractmethod
    def raw_motion(self, times: Tensor) -> Tensor:
        """What the model is trained on: the motion [B, P, 7] at times [B] in 0..1, zero at rest.

        The first four columns are a quaternion wxyz of any length, less the identity, the last three a translation in
        units of `extent`: both are of order one, so that one step size of the optimiser suits rotations, translations
        and scenes of any unit. `forward` turns it into a rotation and scene units.
        """

    def forward(self, times: Tensor) -> tuple[Tensor, Tensor]:
        """Unit quaternions wxyz [B, P, 4] and translations [B, P, 3] in scene units at times [B] in 0..1."""
        raw = self.raw_motion(times)
        identity = raw.new_tensor([1.0, 0.0, 0.0, 0.0])
        return quaternions.normalise(raw[..., :4] + identity), raw[..., 4:] * self.extent

    def arap_loss(self, times: Tensor) -> Tensor:
        """ARAP energy from the canonical frame to times[0], to times[1], ... over the mean squared kernel radius.

        Args:
            times: [B] in 0..1, B >= 1.

        Returns:
            A scalar with gradient to the motion; 0 for a single control point, which has no neighbour.
        """
        if len(self.points) == 1:
            return self.log_radii.sum() * 0
        translations = self.raw_motion(times)[..., 4:] * self.extent
        states = torch.cat([self.points[None], self.points + translations])
        energy = arap_energy(states, self.graph_index, self.graph_weights)
        return energy / self.log_radii.detach().exp().square().mean()


class MLPDeformation(Deformation):
    """The paper's network over position and time.

    Few time frequencies on purpose: ten of them fit the training frames and lose 1.4 dB between them.
    """

    frequencies: Tensor

    def __init__(
        self,
        points: Tensor,
        log_radii: Tensor,
        width: int = 128,
        depth: int = 4,
        position_frequencies: int = 6,
        time_frequencies: int = 4,
        max_extent: float = math.inf,
    ) -> None:
        super().__init__(points, log_radii, max_extent)
        self.register_buffer("frequencies", torch.tensor([position_frequencies, time_frequencies]))
        sizes = [4 + 6 * position_frequencies + 2 * time_frequencies, *[width] * depth]
        self.hidden = torch.nn.ModuleList(torch.nn.Linear(a, b) for a, b in itertools.pairwise(sizes))
        self.head = torch.nn.Linear(sizes[-1], 7)
        torch.nn.init.normal_(self.head.weight, std=1e-3)  # start at rest
        torch.nn.init.zeros_(self.head.bias)

    def raw_motion(self, times: Tensor) -> Tensor:
        position_frequencies, time_frequencies = self.frequencies.tolist()
        positions = _encode((self.points - self.centre) / self.extent, position_frequencies)
        moments = _encode(2 * times[:, None].to(positions) - 1, time_frequencies)
        B, P = len(moments), len(positions)
        x = torch.cat([positions.expand(B, -1, -1), moments[:, None].expand(-1, P, -1)], dim=-1)
        for layer in self.hidden:
            x = torch.relu(layer(x))
        return self.head(x)


class TableDeformation(Deformation):
    """A rotation and a translation per control point and training frame, with a natural cubic spline between frames."""

    knots: Tensor
    left_out: int | None = None
    """The knot that the motion around it does not go through, as if it were no training frame."""

    def __init__(self, points: Tensor, log_radii: Tensor, knots: Tensor, max_extent: float = math.inf) -> None:
        """knots: [F] ascending times in 0..1, one per training frame, F >= 2."""
        super().__init__(points, log_radii, max_extent)
        self.register_buffer("knots", knots.to(torch.float64))
        self.table = torch.nn.Parameter(torch.zeros(len(knots), len(points), 7))

    def raw_motion(self, times: Tensor) -> Tensor:
        basis = spline_basis(self.knots, times.detach().cpu().numpy(), self.left_out)
        if len(self.knots) > LONG_KNOTS and (basis.abs() > LEAST_WEIGHT).sum(dim=1).max() == 1:
            return self.table.index_select(0, basis.argmax(dim=1).to(self.table.device))  # the times are knots
        return at_times(basis, self.table)

    def bending(self) -> Tensor:
        """Mean squared second difference of the translations between knots, in squared scene units; 0 below 3 knots."""
        if len(self.knots) < 3:
            return self.table.sum() * 0
        steps = torch.diff(self.knots).to(self.table) * (len(self.knots) - 1)
        speeds = torch.diff(self.table[..., 4:], dim=0) * self.extent / steps[:, None, None]
        return torch.diff(speeds, dim=0).square().sum(-1).mean()


def _encode(x: Tensor, frequencies: int) -> Tensor:
    """x [..., D] with sin and cos of pi 2^l x for l < frequencies: [..., D (1 + 2 frequencies)]."""
    angles = (x[..., None] * (math.pi * 2.0 ** torch.arange(frequencies, device=x.device))).flatten(-2)
    return torch.cat([x, angles.sin(), angles.cos()], dim=-1)
