"""Differentiable rendering of 3-D Gaussians with the arguments of gsplat: numba on the CPU, gsplat on CUDA."""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from stages.shared.errors import InputError
from stages.splatting import projection_kernels, raster_adjoint, raster_bins, raster_kernels, sh
from stages.splatting.drawing_order import drawing_order


class Rendering(NamedTuple):
    """Images of C cameras, as `rasterize` returns them.

    Attributes:
        colour: [C, H, W, 3], composited over the background; 0..1 if colours are.
        depth: [C, H, W], sum of weight x z-depth in scene units (divide by alpha for the expected depth).
        alpha: [C, H, W], 0..1.
        centres: one [1, N, 2] per camera, projected means in px with autograd history, for densification.
        rows: indices of the N Gaussians in the scene that they are from; None: all of it.
    """

    colour: Tensor
    depth: Tensor
    alpha: Tensor
    centres: list[Tensor]
    rows: Tensor | None = None


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    sh_degree: int | None = None,
    near_plane: float = 0.01,
    backgrounds: Tensor | None = None,
) -> Rendering:
    """Render N Gaussians in C cameras; differentiable in everything but Ks, width, height and near_plane.

    Args:
        means: [N, 3], scene units. quats: [N, 4] wxyz, any length but zero. scales: [N, 3] standard deviations, >= 0.
        opacities: [N] in 0..1. colors: [N, 3], or SH coefficients [N, K, 3] with `sh_degree` 0..3.
        viewmats: cam_from_world [C, 4, 4]. Ks: [C, 3, 3] px, pixel centres at integers.
        near_plane: Gaussians whose mean is nearer (scene units) are not drawn.
        backgrounds: [C, 3], black if None.

    The device of the tensors selects the backend. As in Kerbl et al. 2023, contributions with alpha below 1/255 are
    dropped, alpha is at most 0.999, and compositing of a pixel ends at transmittance 1e-4.
    """
    if backgrounds is None:
        backgrounds = means.new_zeros(len(viewmats), 3)
    render = _render_cuda if means.is_cuda else _render_cpu
    views = []
    for viewmat, K, background in zip(viewmats, Ks, backgrounds, strict=True):
        views_of = _views(means, viewmat) if sh_degree else means  # a constant colour has no direction
        shown = colors if sh_degree is None else sh.sh_to_colour(colors, views_of, sh_degree)
        views.append(render(means, quats, scales, opacities, shown, viewmat, K, width, height, near_plane, background))
    colour, depth, alpha, centres = zip(*views, strict=True)
    return Rendering(_stacked(colour), _stacked(depth), _stacked(alpha), list(centres))


def _stacked(images: tuple[Tensor, ...]) -> Tensor:
    """Images [C, ...] of all cameras; that of a single one is not copied."""
    return images[0].unsqueeze(0) if len(images) == 1 else torch.stack(images)


def choose_device(device: str) -> torch.device:
    """The device of an option "auto", "cpu" or "cuda"; auto takes CUDA if it and gsplat are available and compiled.

    TF32 convolutions are switched off: with 10 bits of mantissa, the variances in SSIM, which are differences of nearly
    equal sums, are lost to rounding.

    Raises:
        InputError: if "cuda" is chosen and CUDA, gsplat or what compiles it is missing.
    """
    torch.backends.cudnn.allow_tf32 = False
    missing = "" if device == "cpu" else _missing()
    if device == "cuda" and missing:
        raise InputError("device: cuda", "a CUDA device and the package gsplat", missing, "set `device: cpu`")
    return torch.device("cpu" if device == "cpu" or missing else "cuda")


def _missing() -> str:
    """What CUDA lacks, or "": gsplat is compiled when its extension is first imported, and has none without nvcc."""
    from importlib.util import find_spec

    if not torch.cuda.is_available():
        return "no CUDA device"
    if find_spec("gsplat") is None:
        return "no gsplat"
    from gsplat.cuda._backend import _C

    return "" if _C is not None else "a gsplat that nvcc has not compiled"


def backend_name(device: torch.device) -> str:
    """Name of the rasteriser that runs on `device`, for the log."""
    return "gsplat on CUDA" if device.type == "cuda" else "numba on the CPU"


def _views(means: Tensor, viewmat: Tensor) -> Tensor:
    """Vectors [N, 3] from the camera centre to the means."""
    return means - (-viewmat[:3, :3].T @ viewmat[:3, 3]).to(means.dtype)


def _render_cpu(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colours: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    near_plane: float,
    background: Tensor,
) -> tuple[Tensor, ...]:
    centres, factors, depths = _Project.apply(means, quats, scales, viewmat, K, width, height, near_plane)  # type: ignore[no-untyped-call]
    images = _Composite.apply(centres, factors, opacities, colours, depths, background, width, height)  # type: ignore[no-untyped-call]
    return *images, centres


def _render_cuda(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colours: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    near_plane: float,
    background: Tensor,
) -> tuple[Tensor, ...]:
    from gsplat import rasterization

    if len(means) == 0:  # gsplat divides by the number of Gaussians
        empty = means.new_zeros(height, width)
        nothing = means.sum()  # with history, as of any other render
        return background.expand(height, width, 3) + nothing, empty, empty, means[None, :, :2]
    gsplat_K = K.to(means.dtype, copy=True)
    gsplat_K[:2, 2] += 0.5  # gsplat puts pixel centres at half-integers
    viewmats = viewmat.to(means.dtype)[None]  # gsplat takes all tensors to have the dtype of the means
    image, alpha, info = rasterization(
        means, quats, scales, opacities, colours, viewmats, gsplat_K[None], width, height,
        near_plane=near_plane, backgrounds=background[None],
        render_mode="RGB+D", packed=False, eps2d=projection_kernels.BLUR,
    )  # fmt: skip
    return image[0, ..., :3], image[0, ..., 3], alpha[0, ..., 0], info["means2d"]


def _float32(tensor: Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().numpy(), np.float32)


class _Project(torch.autograd.Function):
    """Projection of 3-D Gaussians to splats by `projection_kernels`, differentiable in all but K."""

    @staticmethod
    def forward(ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, K: Tensor, width: int,
                height: int, near_plane: float) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        """Centres [1, N, 2] px, factors [N, 3] and z-depths [N] of the splats; depth 0 marks those that are not drawn.

        Args are those of `rasterize`, for one camera: viewmat [4, 4], K [3, 3].
        """
        gaussians = (_float32(means), _float32(quats), _float32(scales))
        camera = (viewmat.detach().double().numpy(), K.detach().double().numpy(), width, height)
        inputs = (*gaussians, *camera, near_plane)
        centres, factors, depths = projection_kernels.project(*inputs)
        ctx.saved = (*gaussians, *camera, factors, depths)
        return torch.from_numpy(centres[None]), torch.from_numpy(factors), torch.from_numpy(depths)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of means [N, 3], quats [N, 4], scales [N, 3] and viewmat [4, 4] from those of the splats.

        Args:
            gradients: of centres [1, N, 2], factors [N, 3] and depths [N].
        """
        g_centres, g_factors, g_depths = map(_float32, gradients)
        posed = ctx.needs_input_grad[3]
        inputs = (*ctx.saved, g_centres[0], g_factors, g_depths, posed)
        *g_gaussians, g_viewmat = projection_kernels.project_adjoint(*inputs)
        g_view = torch.from_numpy(g_viewmat.astype(np.float32)) if posed else None
        return (*map(torch.from_numpy, g_gaussians), g_view, None, None, None, None)


class _Composite(torch.autograd.Function):
    """Compositing of splats by `raster_kernels`, differentiable in all splats and the background."""

    @staticmethod
    def forward(ctx: Any, centres: Tensor, factors: Tensor, opacities: Tensor, colours: Tensor, depths: Tensor,
                background: Tensor, width: int, height: int) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        """Colour [H, W, 3] over the background, accumulated depth [H, W] (scene units) and alpha [H, W].

        Args:
            centres: [1, N, 2] px, factors: [N, 3], depths: [N] from `_Project`.
            opacities: [N] in 0..1. colours: [N, 3]. background: [3].
        """
        ctx.set_materialize_grads(False)
        order = drawing_order(_float32(depths))
        arrays = [_float32(tensor) for tensor in (centres[0], factors, opacities, colours, depths)]
        splats = raster_bins.gather(order, height, *arrays)
        bins = raster_bins.bin_tiles(splats, width, height)
        images = raster_kernels.composite(splats, bins.starts, bins.entries, _float32(background), height, width)
        ctx.saved = (order, splats, bins, images, len(depths))
        colour, depth, transmittance = map(torch.from_numpy, images)
        return colour, depth, 1 - transmittance

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        """Gradients of centres, factors, opacities, colours, depths and background, in the shapes of the inputs.

        Args:
            gradients: of colour [H, W, 3], depth [H, W] and alpha [H, W]; None for an image that the loss does not use.
        """
        order, splats, bins, images, N = ctx.saved
        g_images = [
            np.zeros_like(image) if gradient is None else _float32(gradient)
            for image, gradient in zip(images, gradients, strict=True)
        ]
        sums = raster_adjoint.composite_adjoint(splats, bins.starts, bins.entries, *images, *g_images)
        arrays = raster_adjoint.splat_gradients(order, splats, bins.slots, sums, N)
        g_centres, *g = map(torch.from_numpy, arrays)
        g_background = None
        if ctx.needs_input_grad[5]:
            g_background = torch.from_numpy(np.einsum("hwc,hw->c", g_images[0], images[2]))
        return g_centres[None], *g, g_background, None, None
