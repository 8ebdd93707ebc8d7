"""The rasteriser in plain torch, without kernels: batches of tiles, padded lists, autograd."""

import itertools

import numpy as np
import torch
from torch import Tensor

from stages.splatting import raster_bins
from stages.splatting.drawing_order import drawing_order
from stages.splatting.raster_bins import RANK, TILE

BATCH_PAIRS = 2_000_000
"""A sixteenth of the largest number of padded (Gaussian, pixel) pairs in a batch; it limits the memory."""


def tile_lists(splats: dict[str, Tensor], width: int, height: int) -> list[np.ndarray]:
    """Indices [n] of the Gaussians of every tile, front to back, by the same binning as the kernels."""
    arrays = {name: value.detach().numpy() for name, value in splats.items()}
    order = drawing_order(arrays["depths"])
    names = ("centres", "factors", "opacities", "colours", "depths")
    rows = raster_bins.gather(order, height, *(arrays[name] for name in names))
    bins = raster_bins.bin_tiles(rows, width, height)
    return [order[bins.entries[a:b, RANK]] for a, b in itertools.pairwise(bins.starts)]


def batches(lists: list[np.ndarray]) -> list[np.ndarray]:
    """Indices [m] of tiles in groups with lists of similar length, so that padding is small."""
    order = np.argsort([len(one) for one in lists], kind="stable")
    groups, first = [], 0
    for k in range(1, len(order) + 1):
        full = k < len(order) and (k - first + 1) * len(lists[order[k]]) * TILE * TILE > BATCH_PAIRS * 16
        if full or k == len(order):
            groups.append(order[first:k])
            first = k
    return groups


def composite(splats: dict[str, Tensor], tiles: np.ndarray, lists: list[np.ndarray], width: int) -> Tensor:
    """Channels red, green, blue, depth, alpha [tiles, TILE * TILE, 5] of a batch of tiles."""
    columns = (width + TILE - 1) // TILE
    longest = max(1, max(len(lists[t]) for t in tiles))
    index, used = torch.zeros(len(tiles), longest, dtype=torch.int64), torch.zeros(len(tiles), longest)
    for row, t in enumerate(tiles):
        index[row, : len(lists[t])] = torch.from_numpy(lists[t])
        used[row, : len(lists[t])] = 1
    corner = torch.tensor(np.stack([tiles % columns, tiles // columns], axis=-1) * TILE, dtype=torch.float32)
    v, u = torch.meshgrid(torch.arange(TILE), torch.arange(TILE), indexing="ij")
    pixels = corner[:, None] + torch.stack([u, v], dim=-1).reshape(1, -1, 2)
    delta = splats["centres"][index][:, :, None] - pixels[:, None]
    f0, f1, f2 = splats["factors"][index].unbind(-1)
    q = f0[..., None] * delta[..., 0] + f1[..., None] * delta[..., 1]
    exponent = q * q + (f2[..., None] * delta[..., 1]) ** 2
    alpha = (splats["opacities"][index][..., None] * torch.exp(-exponent)).clamp_max(0.999)
    alpha = torch.where(alpha >= 1 / 255, alpha, 0.0) * used[..., None]
    passed = torch.cumprod(1 - alpha, dim=1)
    before = torch.cat([torch.ones_like(passed[:, :1]), passed[:, :-1]], dim=1)
    weights = torch.where(before > 1e-4, before * alpha, 0.0)
    values = torch.cat(
        [splats["colours"], splats["depths"][:, None], torch.ones_like(splats["depths"])[:, None]], dim=1
    )
    return torch.einsum("tkp,tkc->tpc", weights, values[index])


def forward_and_backward(splats: dict[str, Tensor], weights: Tensor, width: int, height: int) -> dict[str, Tensor]:
    """Gradients of sum(weights * image), tile batch by tile batch; weights [tiles, TILE * TILE, 5]."""
    leaves = {name: value.detach().requires_grad_() for name, value in splats.items()}
    lists = tile_lists(splats, width, height)
    for tiles in batches(lists):
        (composite(leaves, tiles, lists, width) * weights[tiles]).sum().backward()  # type: ignore[no-untyped-call]
    return {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
