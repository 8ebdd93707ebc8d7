"""Motion of the control points over time: two models behind one interface, and their file.

Both map times 0..1 to a rotation and a translation per control point, relative to the canonical frame.
"""

import abc
import contextlib
import itertools
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from stages.control import quaternions
from stages.control.arap import arap_graph
from stages.shared.artifacts import read_model, read_table, refuse_infinite, write_model, write_table


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

    def __init__(self, points: Tensor, log_radii: Tensor, knots: Tensor, max_extent: float = math.inf) -> None:
        """knots: [F] ascending times in 0..1, one per training frame, F >= 2."""
        super().__init__(points, log_radii, max_extent)
        self.register_buffer("knots", knots.to(torch.float64))
        self.table = torch.nn.Parameter(torch.zeros(len(knots), len(points), 7))

    def raw_motion(self, times: Tensor) -> Tensor:
        basis = spline_basis(self.knots, times.detach().cpu().numpy())
        return at_times(basis, self.table)

    def bending(self) -> Tensor:
        """Mean squared second difference of the translations between knots, in squared scene units; 0 below 3 knots."""
        if len(self.knots) < 3:
            return self.table.sum() * 0
        steps = torch.diff(self.knots).to(self.table) * (len(self.knots) - 1)
        speeds = torch.diff(self.table[..., 4:], dim=0) * self.extent / steps[:, None, None]
        return torch.diff(speeds, dim=0).square().sum(-1).mean()


@contextlib.contextmanager
def one_torch_thread() -> Iterator[None]:
    """Torch on one thread, as block or decorator: with more, its sums and products round by their number.

    For tensors that are too small for more threads to pay; compiled kernels keep theirs.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


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
    return torch.as_tensor(CubicSpline(ascending, np.eye(len(ascending)), bc_type="natural")(inside))


def _encode(x: Tensor, frequencies: int) -> Tensor:
    """x [..., D] with sin and cos of pi 2^l x for l < frequencies: [..., D (1 + 2 frequencies)]."""
    angles = (x[..., None] * (math.pi * 2.0 ** torch.arange(frequencies, device=x.device))).flatten(-2)
    return torch.cat([x, angles.sin(), angles.cos()], dim=-1)


def deformation_tensors(deformation: Deformation) -> dict[str, np.ndarray]:
    """Every tensor of the model by name, enough to rebuild it; the names tell the kind."""
    return {name: tensor.detach().cpu().numpy() for name, tensor in deformation.state_dict().items()}


def deformation_from_tensors(tensors: Mapping[str, np.ndarray]) -> Deformation:
    """Rebuild the model that `deformation_tensors` took apart."""
    state = {name: torch.from_numpy(np.array(values)) for name, values in tensors.items()}
    points, log_radii = state["points"], state["log_radii"]
    model: Deformation
    if "knots" in state:
        model = TableDeformation(points, log_radii, state["knots"])
    else:
        width, depth = len(state["hidden.0.weight"]), sum(name.endswith(".weight") for name in state) - 1
        model = MLPDeformation(points, log_radii, width, depth, *state["frequencies"].tolist())
    model.load_state_dict(state)
    return model


def save_points(path: Path, deformation: Deformation | None, metadata: Mapping[str, Any]) -> None:
    """Write `control/points.parquet`: x y z radius, in scene units of the canonical frame; no row without motion."""
    points = np.zeros((0, 3), np.float32) if deformation is None else deformation.points.cpu().numpy()
    radii = np.zeros(0, np.float32) if deformation is None else deformation.log_radii.detach().exp().cpu().numpy()
    columns = {name: points[:, axis] for axis, name in enumerate("xyz")} | {"radius": radii}
    write_table(path, columns, {"units": "scene units, canonical frame", **metadata})


def save_deformation(path: Path, deformation: Deformation | None, metadata: Mapping[str, Any]) -> None:
    """Write `control/deformation.safetensors`: the motion without the points; no tensor without motion."""
    tensors = {} if deformation is None else deformation_tensors(deformation)
    motion = {name: values for name, values in tensors.items() if name not in ("points", "log_radii")}
    write_model(path, motion, metadata)


def load_deformation(path: Path, points_path: Path) -> Deformation | None:
    """Read what `save_deformation` and `save_points` wrote; None for a scene without moving parts."""
    table = read_table(points_path)
    refuse_infinite(points_path, table)
    if len(table["x"]) == 0:
        return None
    points = np.stack([table[name] for name in "xyz"], axis=-1)
    return deformation_from_tensors(read_model(path) | {"points": points, "log_radii": np.log(table["radius"])})
