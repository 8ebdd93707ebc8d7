"""Adaptive control points: added where gradients are large, removed where no track uses them (paper, Eq. 13)."""

import numpy as np
import torch
from torch import Tensor

from stages.control.canonical import kernel_radii
from stages.deformation import lbs
from stages.deformation.motion_models import TableDeformation


def weighted_gradient(weights: Tensor, index: Tensor, gradients: Tensor, P: int) -> Tensor:
    """Weighted squared gradient of each control point, [P]: g_k = sum_j w_jk |dL/dmu_j|^2 (paper, Eq. 13).

    Args:
        weights: [N, K] skinning weights. index: [N, K] control points. gradients: [N, 3] of the skinned positions.
    """
    pull = weights * gradients.square().sum(-1, keepdim=True)
    return torch.zeros(P, dtype=pull.dtype).index_add(0, index.flatten(), pull.flatten())


def new_places(carried: Tensor, weights: Tensor, index: Tensor, gradients: Tensor, P: int, count: int) -> Tensor:
    """Positions [m, 3] of at most `count` new control points, one for each existing point of largest gradient.

    A new point is the mean of the positions that follow the existing point, weighted by their squared gradients.

    Args:
        carried: [N, 3] canonical positions; the rest as in `weighted_gradient`.
    """
    pull = weighted_gradient(weights, index, gradients, P)
    chosen = pull.topk(min(count, int((pull > 0).sum()))).indices
    share = weights * gradients.square().sum(-1, keepdim=True)
    sums = torch.zeros(P, 3, dtype=carried.dtype)
    sums.index_add_(0, index.flatten(), (share[..., None] * carried[:, None]).flatten(0, 1))
    return (sums / pull.clamp_min(torch.finfo(pull.dtype).tiny)[:, None])[chosen]


def used(index: Tensor, P: int) -> Tensor:
    """Which of P control points [P] are among the K nearest, `index` [N, K], of any position."""
    mask = torch.zeros(P, dtype=torch.bool, device=index.device)
    mask[index.flatten()] = True
    return mask


@torch.no_grad()
def regrow(table: TableDeformation, kept: Tensor, places: Tensor, K: int) -> TableDeformation:
    """A table with the points `kept` [P] bool and new ones at `places` [m, 3].

    The new points start with the motion blended from the K nearest old ones, so the deformation changes little. Their
    radii follow the closer spacing; kept points keep their radii.
    """
    quats, translations = table(table.knots)
    index, sq_dist = lbs.neighbours(table.points, places, K)
    weights = lbs.lbs_weights(sq_dist, table.log_radii, index)
    unturned = places.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(places), 1)
    motions = zip(quats, translations, strict=True)
    moved = [lbs.blend(places, unturned, table.points, *motion, weights, index) for motion in motions]
    shifts, turns = torch.stack([at - places for at, _ in moved]), torch.stack([turn for _, turn in moved])
    points = torch.cat([table.points[kept], places])
    log_radii = torch.from_numpy(np.log(kernel_radii(points.double().numpy()))).float()
    log_radii[: int(kept.sum())] = table.log_radii[kept]
    grown = TableDeformation(points, log_radii, table.knots, max_extent=float(table.extent))
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    grown.table[..., :4] = torch.cat([quats[:, kept], turns], dim=1) - identity
    grown.table[..., 4:] = torch.cat([translations[:, kept], shifts], dim=1) / grown.extent
    return grown
