"""The CUDA backend: where gsplat has pixel centres, and on a GPU the same image and gradients as the kernels."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import reference_rasterizer as reference
import torch
from raster_scene import BACKGROUND, HEIGHT, NAMES, WIDTH, intrinsics, loss, render_kernels, render_reference, scene
from torch import Tensor

from stages.splatting import projection_kernels
from stages.splatting.rasterize import _render_cuda, rasterize


def test_the_adapter_puts_pixel_centres_where_gsplat_has_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in with gsplat's convention, pixel centres at half-integers, must show what our kernels show."""

    def rasterization(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor,
                      viewmats: Tensor, Ks: Tensor, width: int, height: int, backgrounds: Tensor,
                      **settings: object) -> tuple[Tensor, Tensor, dict[str, Tensor]]:  # fmt: skip
        assert settings["eps2d"] == projection_kernels.BLUR
        tensors = (means, quats, scales, opacities, colors, viewmats[0])
        assert {tensor.dtype for tensor in (*tensors, Ks, backgrounds)} == {torch.float32}  # it reads all as the first
        K = Ks[0].clone()
        K[:2, 2] -= 0.5
        out = reference.render(*tensors, K=K, width=width, height=height, background=backgrounds[0])
        image = torch.cat([out.colour, out.depth[..., None]], dim=-1)
        return image[None], out.alpha[None, ..., None], {"means2d": torch.zeros(1, len(means), 2)}

    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=rasterization))
    tensors, K = scene(), intrinsics()
    single = {name: tensor.float() for name, tensor in tensors.items()} | {"viewmat": tensors["viewmat"]}  # as trained
    arguments = (*(single[name] for name in NAMES), K, WIDTH, HEIGHT, 0.01, BACKGROUND.float())
    colour, depth, alpha, _ = _render_cuda(*arguments)
    safe = render_reference(tensors).safe
    for found, expected in zip((colour, depth, alpha), render_kernels(tensors), strict=True):
        assert (found - expected)[safe].abs().max() < 4e-5
    assert torch.equal(K, intrinsics())  # the caller's camera stays as it was


def test_no_gaussian_never_reaches_gsplat(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its count of batches divides by the number of Gaussians. A step of the training differentiates what is drawn."""
    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=None))
    none = [torch.zeros(0, *shape, requires_grad=True) for shape in ((3,), (4,), (3,), (), (3,))]
    camera = (torch.eye(4).double(), intrinsics(), WIDTH, HEIGHT, 0.01, BACKGROUND.float())
    colour, depth, alpha, centres = _render_cuda(*none, *camera)
    centres.retain_grad()
    colour.sum().backward()
    assert torch.equal(colour, BACKGROUND.float().expand(HEIGHT, WIDTH, 3))
    assert not depth.any()
    assert not alpha.any()


def render_on(device: torch.device, sh_degree: int) -> tuple[dict[str, Tensor], tuple[Tensor, Tensor, Tensor]]:
    """Gradients of `loss` and the outputs of the scene with spherical harmonics, by the backend of the device."""
    tensors = scene()
    tensors["colours"] = 0.3 * torch.tensor(np.random.default_rng(3).normal(size=(60, (sh_degree + 1) ** 2, 3)))
    leaves = {name: value.float().to(device).requires_grad_() for name, value in tensors.items()}
    single = dict(leaves)
    viewmats, colors = single.pop("viewmat")[None], single.pop("colours")
    camera = {"viewmats": viewmats, "Ks": intrinsics().float().to(device)[None], "width": WIDTH, "height": HEIGHT}
    background = BACKGROUND.float().to(device)[None]
    out = rasterize(**single, colors=colors, **camera, sh_degree=sh_degree, backgrounds=background)
    outputs = (out.colour[0].cpu(), out.depth[0].cpu(), out.alpha[0].cpu())
    loss(*outputs, render_reference(scene()).safe).backward()
    return {name: leaf.grad.cpu() for name, leaf in leaves.items() if leaf.grad is not None}, outputs


@pytest.mark.parametrize("sh_degree", [0, 3])
def test_gsplat_has_the_same_image_and_gradients(sh_degree: int, cuda: torch.device) -> None:
    gradients_cuda, outputs_cuda = render_on(cuda, sh_degree)
    gradients_cpu, outputs_cpu = render_on(torch.device("cpu"), sh_degree)
    safe = render_reference(scene()).safe
    for found, expected in zip(outputs_cuda, outputs_cpu, strict=True):
        assert (found - expected)[safe].abs().max() < 1e-4
    for name in ("means", "quats", "scales", "opacities", "colours", "viewmat"):
        error = (gradients_cuda[name] - gradients_cpu[name]).abs().max() / gradients_cpu[name].abs().max()
        assert error < 1e-3, f"{name}: {error:.1e}"
