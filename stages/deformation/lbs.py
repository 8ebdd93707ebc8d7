"""Linear blend skinning: Gaussians follow the K nearest control points (4D3R's MA-GS).

w~_jk = exp(-|mu_j - p_k|^2 / (2 sigma_k^2)), w_jk = w~_jk / sum_k w~_jk,
mu'_j = sum_k w_jk (R_k (mu_j - p_k) + p_k + T_k), q'_j = normalise((sum_k w_jk r_k) x q_j).
"""

from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from stages.deformation import lbs_kernels, weight_kernels
from stages.shared import quaternions

INVERSE_STEPS, CLOSE = 12, 1e-3
"""Of the inverse: most steps, and the error, in kernel radii, that ends them. Most points need four steps, those where
control points turn apart many more: with four, 24 % of the pixels that orbit_two lifts are given up, with twelve 15."""


def neighbours(points: Tensor, means: Tensor, K: int) -> tuple[Tensor, Tensor]:
    """The K control points nearest to each mean (all of them if there are fewer), nearest first.

    Args:
        points: [P, 3] control points, P >= 1.
        means: [N, 3].

    Returns:
        index int64 [N, K] and sq_dist float32 [N, K] in squared scene units, both on the device of `means`;
        neither carries a gradient.
    """
    K = min(K, len(points))
    query = means.detach().cpu().numpy().astype(np.float64)
    dist, index = cKDTree(points.detach().cpu().numpy().astype(np.float64)).query(query, k=np.arange(1, K + 1))
    sq_dist = torch.as_tensor(np.square(dist).reshape(-1, K), dtype=torch.float32, device=means.device)
    return torch.as_tensor(index.reshape(-1, K), dtype=torch.int64, device=means.device), sq_dist


def lbs_weights(sq_dist: Tensor, log_radii: Tensor, index: Tensor) -> Tensor:
    """Normalised exponential kernel [N, K]; rows sum to one however far the point is from every control point.

    The softmax shifts the exponents by the largest before exp: the plain quotient is 0 / 0 some 13 radii away.

    Args:
        sq_dist: [N, K] squared distances. log_radii: [P] logarithms of sigma_k. index: [N, K].
    """
    if sq_dist.device.type != "cpu":
        return lbs_weights_torch(sq_dist, log_radii, index)
    weights: Tensor = _Weights.apply(sq_dist, torch.exp(-2 * log_radii), index)  # type: ignore[no-untyped-call]
    return weights


def lbs_weights_torch(sq_dist: Tensor, log_radii: Tensor, index: Tensor) -> Tensor:
    """`lbs_weights` as gather and softmax: for accelerators, and the oracle of the kernel."""
    return torch.softmax(-0.5 * sq_dist * torch.exp(-2 * log_radii)[index], dim=-1)


def blend(
    means: Tensor,
    quats: Tensor,
    points: Tensor,
    point_quats: Tensor,
    point_translations: Tensor,
    weights: Tensor,
    index: Tensor,
) -> tuple[Tensor, Tensor]:
    """Move and turn Gaussians with their control points; differentiable in everything but `index`.

    Quaternions q and -q are one rotation: each neighbour's sign is aligned with the heaviest neighbour's, which
    keeps the blend at least 1/K long, so its normalisation is safe by construction.

    Args:
        means: [N, 3]. quats: [N, 4] wxyz, any length but zero. points: [P, 3]. point_quats: [P, 4] unit.
        point_translations: [P, 3]. weights: [N, K], rows sum to one. index: [N, K].

    Returns:
        means' [N, 3] and unit quats' [N, 4]. On the CPU a fused numba kernel, elsewhere `blend_torch`.
    """
    arguments = (means, quats, points, point_quats, point_translations, weights, index)
    if means.device.type != "cpu":
        return blend_torch(*arguments)
    moved: tuple[Tensor, Tensor] = _Blend.apply(*arguments)  # type: ignore[no-untyped-call]
    return moved


def blend_values(values: Tensor, weights: Tensor, index: Tensor) -> Tensor:
    """Weighted sums [N, C] of the values [P, C] of control points; differentiable in the values alone.

    Args:
        weights: [N, K]. index: [N, K].
    """
    if values.device.type != "cpu":
        return torch.einsum("nk,nkc->nc", weights.detach(), values[index])
    blended: Tensor = _BlendValues.apply(values, weights, index)  # type: ignore[no-untyped-call]
    return blended


def inverse_blend(
    moved: Tensor, points: Tensor, point_quats: Tensor, point_translations: Tensor, log_radii: Tensor, K: int
) -> tuple[Tensor, Tensor]:
    """Where in the canonical frame a point lies that is seen at `moved` now; without gradient.

    Fixed point of x <- x + R(x)^T (moved - blend(x)) with R the blended rotation, from the blend of inverse motions. A
    solution by the blended matrix is no nearer after as many steps. The matrix is singular where control points turn to
    opposite sides, and LAPACK's least squares round by where their work space lies: trainings did not repeat.

    Args:
        moved: [N, 3]. points, point_translations: [P, 3]. point_quats: [P, 4] unit. log_radii: [P].

    Returns:
        means [N, 3], and the distance [N] of `moved` to its nearest moved control point in kernel radii of that point:
        beyond a few radii nothing known moves there.
    """
    with torch.no_grad():
        now, radii = points + point_translations, log_radii.exp()
        rotations = quaternions.rotation_matrices(point_quats)
        index, sq_dist = neighbours(now, moved, K)
        remoteness = sq_dist[:, 0].sqrt() / radii[index[:, 0]]
        weights = lbs_weights(sq_dist, log_radii, index)
        means = points[index] + _turned_back(rotations[index], moved[:, None] - now[index])
        means = (weights[..., None] * means).sum(1)
        unturned, far = moved.new_tensor([1.0, 0.0, 0.0, 0.0]), torch.arange(len(moved), device=moved.device)
        for _ in range(INVERSE_STEPS):
            index, sq_dist = neighbours(points, means[far], K)
            motion = (points, point_quats, point_translations, lbs_weights(sq_dist, log_radii, index), index)
            there, quats = blend(means[far], unturned.expand(len(far), 4), *motion)
            missed = moved[far] - there
            means[far] += _turned_back(quaternions.rotation_matrices(quats), missed)
            far = far[missed.norm(dim=-1) > CLOSE * radii[index[:, 0]]]
        return means, remoteness


def _turned_back(rotations: Tensor, vectors: Tensor) -> Tensor:
    """R^T v [..., 3] for R [..., 3, 3] and v [..., 3]."""
    return (rotations * vectors[..., None]).sum(-2)


def blend_torch(
    means: Tensor,
    quats: Tensor,
    points: Tensor,
    point_quats: Tensor,
    point_translations: Tensor,
    weights: Tensor,
    index: Tensor,
) -> tuple[Tensor, Tensor]:
    """`blend` as gather and einsum: for accelerators, any float type, and the oracle of the kernel."""
    rotations = quaternions.rotation_matrices(point_quats)
    local = means[:, None] - points[index]
    moved = torch.einsum("nkab,nkb->nka", rotations[index], local) + (points + point_translations)[index]
    neighbour_quats = point_quats[index]
    heaviest = neighbour_quats.take_along_dim(weights.argmax(-1)[:, None, None], dim=1)
    signs = torch.where((neighbour_quats * heaviest).sum(-1) < 0, -1.0, 1.0).detach().to(weights.dtype)
    blended = ((weights * signs)[..., None] * neighbour_quats).sum(1)
    turned = quaternions.multiply(quaternions.normalise(blended), quaternions.normalise(quats))
    return (weights[..., None] * moved).sum(1), turned


class _Weights(torch.autograd.Function):
    """The softmax kernel: torch's gather of the radii costs more, backwards, than all the rest."""

    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> Tensor:
        arrays = [tensor.detach().contiguous().numpy() for tensor in tensors]
        weights = weight_kernels.softmax_weights(*arrays)
        ctx.arrays = (*arrays, weights)
        return torch.from_numpy(weights)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        moving = ctx.needs_input_grad[0]
        given = (*ctx.arrays, gradients[0].contiguous().numpy(), moving)
        g_sq_dist, g_radii = weight_kernels.softmax_weights_adjoint(*given)
        return torch.from_numpy(g_sq_dist) if moving else None, torch.from_numpy(g_radii), None


class _Blend(torch.autograd.Function):
    """The fused kernel with its hand-written backward pass."""

    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> tuple[Tensor, Tensor]:
        arrays = [tensor.detach().contiguous().numpy() for tensor in tensors]
        ctx.arrays = arrays
        moved, turned = lbs_kernels.blend(*arrays)
        return torch.from_numpy(moved), torch.from_numpy(turned)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        given = (*ctx.arrays, *(gradient.contiguous().numpy() for gradient in gradients))
        return (*map(torch.from_numpy, lbs_kernels.blend_adjoint(*given)), None)


class _BlendValues(torch.autograd.Function):
    """The sums and their scatter back in a fixed order."""

    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> Tensor:
        values, *ctx.arrays = (tensor.detach().contiguous().numpy() for tensor in tensors)
        ctx.P = len(values)
        return torch.from_numpy(weight_kernels.blend_values(values, *ctx.arrays))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        given = (gradients[0].contiguous().numpy(), *ctx.arrays, ctx.P)
        g_values = weight_kernels.blend_values_adjoint(*given)
        return torch.from_numpy(g_values), None, None
