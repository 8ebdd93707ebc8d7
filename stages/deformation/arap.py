"""As rigid as possible: neighbouring control points should turn together (paper; Sorkine and Alexa 2007)."""

from typing import Any

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from stages.deformation import arap_kernels

NEIGHBOURS = 8


def procrustes(covariances: Tensor) -> Tensor:
    """The rotations R [..., 3, 3] that maximise trace(R C) for C [..., 3, 3] = sum_k w_k source_k target_k^T.

    C = U S V^T gives R = V diag(1, 1, det(V U^T)) U^T. Taken without gradient: the derivative of the SVD is
    infinite at equal singular values, while R minimises the energy, so its own derivative does not enter.
    With zero singular values R is one of many equally good rotations.
    """
    with torch.no_grad():
        U, _, Vh = torch.linalg.svd(covariances.double())
        V, Ut = Vh.mT, U.mT
        flip = torch.ones_like(V[..., 0])
        flip[..., 2] = torch.linalg.det(V @ Ut).sign()
        return ((V * flip[..., None, :]) @ Ut).to(covariances.dtype)


def arap_energy(states: Tensor, index: Tensor, weights: Tensor) -> Tensor:
    """Mean over steps and points of sum_k w_ik |(x_i' - x_k') - R_i (x_i - x_k)|^2, x and x' consecutive states.

    Args:
        states: [B, P, 3] positions at B >= 2 moments. index: [P, K] neighbours. weights: [P, K], without gradient.
    """
    if states.device.type != "cpu":
        return arap_energy_torch(states, index, weights)
    energy: Tensor = _Energy.apply(states, index, weights)  # type: ignore[no-untyped-call]
    return energy


def arap_energy_torch(states: Tensor, index: Tensor, weights: Tensor) -> Tensor:
    """`arap_energy` by the SVD: for accelerators, and the oracle of the kernel."""
    edges = states[:, :, None] - states[:, index]
    before, after = edges[:-1], edges[1:]
    rotations = procrustes(torch.einsum("pk,bpki,bpkj->bpij", weights, before.detach(), after.detach()))
    residual = after - torch.einsum("bpij,bpkj->bpki", rotations, before)
    return (weights * residual.square().sum(-1)).sum(-1).mean()


class _Energy(torch.autograd.Function):
    """The kernel gives energy and gradient at once: the rotations minimise, so they count as constants."""

    @staticmethod
    def forward(ctx: Any, states: Tensor, index: Tensor, weights: Tensor) -> Tensor:
        arrays = (states.detach().double().numpy(), index.numpy(), weights.double().numpy())
        energy, gradient = arap_kernels.energy(*arrays)
        ctx.gradient = torch.from_numpy(gradient).to(states.dtype)
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
