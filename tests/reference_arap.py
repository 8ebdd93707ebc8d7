"""Rigidity by the singular value decomposition of torch: the oracle of the kernel."""

import torch
from torch import Tensor


def procrustes(covariances: Tensor) -> Tensor:
    """The rotations R [..., 3, 3] that maximise trace(R C) for C [..., 3, 3] = sum_k w_k source_k target_k^T.

    C = U S V^T gives R = V diag(1, 1, det(V U^T)) U^T, without gradient. With zero singular values R is one of many
    equally good rotations.
    """
    with torch.no_grad():
        U, _, Vh = torch.linalg.svd(covariances.double())
        V, Ut = Vh.mT, U.mT
        flip = torch.ones_like(V[..., 0])
        flip[..., 2] = torch.linalg.det(V @ Ut).sign()
        return ((V * flip[..., None, :]) @ Ut).to(covariances.dtype)


def arap_energy(states: Tensor, index: Tensor, weights: Tensor) -> Tensor:
    """`stages.deformation.arap.arap_energy` by the SVD."""
    edges = states[:, :, None] - states[:, index]
    before, after = edges[:-1], edges[1:]
    rotations = procrustes(torch.einsum("pk,bpki,bpkj->bpij", weights, before.detach(), after.detach()))
    residual = after - torch.einsum("bpij,bpkj->bpki", rotations, before)
    return (weights * residual.square().sum(-1)).sum(-1).mean()
