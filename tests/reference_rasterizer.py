"""A slow float64 rasteriser in plain torch: the oracle of the kernels. Every Gaussian meets every pixel."""

from typing import NamedTuple

import torch
from torch import Tensor

BLUR, MIN_ALPHA, MAX_ALPHA, MIN_TRANSMITTANCE = 0.3, 1 / 255, 0.999, 1e-4


class Reference(NamedTuple):
    """colour [H, W, 3], depth [H, W], alpha [H, W]; `safe` [H, W] bool: no threshold is within `margin` there."""

    colour: Tensor
    depth: Tensor
    alpha: Tensor
    safe: Tensor


def rotation(quats: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of quaternions wxyz [N, 4] of any length."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


def project(means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int,
            ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Centres [N, 2], covariances [N, 2, 2] (with blur) and depths [N] by the textbook formulas."""
    p = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    x, y, z = p.unbind(-1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5
    slope_x = (x / z).clamp(-cx / fx - 0.15 * width / fx, (width - cx) / fx + 0.15 * width / fx)
    slope_y = (y / z).clamp(-cy / fy - 0.15 * height / fy, (height - cy) / fy + 0.15 * height / fy)
    zero = torch.zeros_like(z)
    J = torch.stack([fx / z, zero, -fx * slope_x / z, zero, fy / z, -fy * slope_y / z], dim=-1).reshape(-1, 2, 3)
    R = rotation(quats)
    cov = R @ torch.diag_embed(scales**2) @ R.mT
    W = J @ viewmat[:3, :3]
    cov2d = W @ cov @ W.mT + BLUR * torch.eye(2, dtype=means.dtype)
    return torch.stack([fx * x / z + cx - 0.5, fy * y / z + cy - 0.5], dim=-1), cov2d, z


def render(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colours: Tensor, viewmat: Tensor, K: Tensor,
           width: int, height: int, near_plane: float = 0.01, background: Tensor | None = None, margin: float = 1e-5,
           ) -> Reference:  # fmt: skip
    """Front-to-back compositing with the thresholds of 3DGS, one Gaussian after the other."""
    centres, cov2d, z = project(means, quats, scales, viewmat, K, width, height)
    precision = torch.linalg.inv(cov2d)
    v, u = torch.meshgrid(
        torch.arange(height, dtype=means.dtype), torch.arange(width, dtype=means.dtype), indexing="ij"
    )
    pixels = torch.stack([u, v], dim=-1)
    colour, depth = means.new_zeros(height, width, 3), means.new_zeros(height, width)
    T, safe = means.new_ones(height, width), torch.ones(height, width, dtype=torch.bool)
    for i in torch.argsort(z, stable=True).tolist():
        if z[i] <= near_plane:
            continue
        d = centres[i] - pixels
        raw = opacities[i] * torch.exp(-0.5 * torch.einsum("hwa,ab,hwb->hw", d, precision[i], d))
        kept = (raw >= MIN_ALPHA) & (T > MIN_TRANSMITTANCE)
        safe &= ((raw - MIN_ALPHA).abs() > margin) & ((raw - MAX_ALPHA).abs() > margin)
        safe &= (T - MIN_TRANSMITTANCE).abs() > margin
        alpha = torch.where(kept, raw.clamp_max(MAX_ALPHA), 0.0)
        colour = colour + (T * alpha)[..., None] * colours[i]
        depth = depth + T * alpha * z[i]
        T = T * (1 - alpha)
    if background is not None:
        colour = colour + T[..., None] * background
    return Reference(colour, depth, 1 - T, safe)
