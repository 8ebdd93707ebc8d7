"""As rigid as possible: neighbouring control points should turn together (paper; Sorkine and Alexa 2007)."""

from typing import Any

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from stages.deformation import arap_kernels

NEIGHBOURS = 8


def arap_energy(states: Tensor, index: Tensor, weights: Tensor) -> Tensor:
    """Mean over steps and points of sum_k w_ik |(x_i' - x_k') - R_i (x_i - x_k)|^2, x and x' consecutive states.

    Args:
        states: [B, P, 3] positions at B >= 2 moments. index: [P, K] neighbours. weights: [P, K], without gradient.

    Points on a GPU are copied for the kernel: they are few, and small matrices are decomposed slowly there.
    """
    energy: Tensor = _Energy.apply(states, index, weights)  # type: ignore[no-untyped-call]
    return energy


class _Energy(torch.autograd.Function):
    """The kernel gives energy and gradient at once: the rotations minimise, so they count as constants."""

    @staticmethod
    def forward(ctx: Any, states: Tensor, index: Tensor, weights: Tensor) -> Tensor:
        arrays = (states.detach().cpu().double().numpy(), index.cpu().numpy(), weights.cpu().double().numpy())
        energy, gradient = arap_kernels.energy(*arrays)
        ctx.gradient = torch.from_numpy(gradient).to(states)
        return states.new_tensor(energy)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        return gradients[0] * ctx.gradient, None, None


def arap_graph(points: Tensor) -> tuple[Tensor, Tensor]:
    """Neighbours int64 [P, K] of the points [P, 3] and their weights [P, K], which sum to one per point.

    The weight is exp(-d^2 / (2 d_mean^2)) by softmax; coincident points all weigh the same. A single point has K = 0.
    """
    positions = points.detach().cpu().double().numpy()
    K = min(NEIGHBOURS, len(points) - 1)
    if K == 0:
        return torch.zeros(len(points), 0, dtype=torch.int64, device=points.device), points.new_zeros(len(points), 0)
    dist, index = cKDTree(positions).query(positions, k=K + 1)
    sq_dist = torch.as_tensor(dist[:, 1:] ** 2)
    unit = sq_dist.mean()
    weights = torch.softmax(-sq_dist / (2 * torch.where(unit > 0, unit, 1.0)), dim=-1)
    return torch.as_tensor(index[:, 1:], dtype=torch.int64, device=points.device), weights.to(points)
