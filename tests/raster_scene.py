"""Random Gaussians before a tilted camera, drawn by the kernels and by the reference: for tests of the rasteriser."""

import numpy as np
import reference_rasterizer as reference
import torch
from torch import Tensor

from stages.splatting.rasterize import rasterize

WIDTH, HEIGHT = 53, 37  # neither a multiple of the tile
NAMES = ("means", "quats", "scales", "opacities", "colours", "viewmat")


def scene(N: int = 60, seed: int = 0) -> dict[str, Tensor]:
    """N Gaussians of mixed shapes in front of a tilted camera, float64."""
    random = np.random.default_rng(seed)
    means = random.uniform([-1.2, -0.9, 1.5], [1.2, 0.9, 4.0], (N, 3))
    values = {
        "means": means,
        "quats": random.normal(size=(N, 4)),
        "scales": np.exp(random.uniform(-4.0, -1.2, (N, 3))),
        "opacities": random.uniform(0.05, 0.95, N),
        "colours": random.uniform(0, 1, (N, 3)),
    }
    tensors = {name: torch.tensor(value) for name, value in values.items()}
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = reference.rotation(torch.tensor([[1.0, 0.04, -0.06, 0.1]], dtype=torch.float64))[0]
    viewmat[:3, 3] = torch.tensor([0.05, -0.1, 0.2])
    return tensors | {"viewmat": viewmat}


def intrinsics() -> Tensor:
    return torch.tensor([[45.0, 0, 26.3], [0, 47.0, 17.6], [0, 0, 1]], dtype=torch.float64)


BACKGROUND = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)


def render_kernels(tensors: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    single = {name: value.float() for name, value in tensors.items()}
    viewmat = single.pop("viewmat")
    single["colors"] = single.pop("colours")
    K, background = intrinsics().float()[None], BACKGROUND.float()[None]
    out = rasterize(**single, viewmats=viewmat[None], Ks=K, width=WIDTH, height=HEIGHT, backgrounds=background)
    return out.colour[0], out.depth[0], out.alpha[0]


def render_reference(tensors: dict[str, Tensor]) -> reference.Reference:
    return reference.render(
        *(tensors[name] for name in NAMES), K=intrinsics(), width=WIDTH, height=HEIGHT, background=BACKGROUND
    )


def loss(colour: Tensor, depth: Tensor, alpha: Tensor, safe: Tensor) -> Tensor:
    """A random linear functional of all outputs, blind to pixels at a threshold."""
    random = np.random.default_rng(5)
    weights = torch.tensor(random.normal(size=(HEIGHT, WIDTH, 5))) * safe[..., None]
    return (weights * torch.cat([colour, depth[..., None], alpha[..., None]], dim=-1).double()).sum()
