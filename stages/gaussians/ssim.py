"""Structural similarity as a differentiable torch function: fused numba on the CPU, convolutions on CUDA.

Convention (that of 3DGS): 11 x 11 Gaussian window with sigma 1.5 px, zero padding, C1 = 0.01^2, C2 = 0.03^2 for values
in 0..1, mean over pixels and channels.
"""

from typing import Any

import torch
from torch import Tensor

from stages.gaussians import ssim_kernels

WINDOW = ssim_kernels.window()


class Target:
    """An image [H, W, C] in 0..1 with its blurred moments [2 C, H, W], computed once for all comparisons with it."""

    def __init__(self, image: Tensor) -> None:
        self.image = image.contiguous()
        planes = self.image.movedim(-1, 0)
        self.moments = _convolve(torch.cat([planes, planes * planes]))


def ssim(image: Tensor, target: Target) -> Tensor:
    """Mean SSIM (scalar, at most 1) of image [H, W, C] and target; differentiable in `image`."""
    if image.is_cuda:
        return ssim_torch(image, target)
    value: Tensor = _Ssim.apply(image, target.image, target.moments)  # type: ignore[no-untyped-call]
    return value


class _Ssim(torch.autograd.Function):
    """Mean SSIM by the numba kernels. The forward pass also computes the gradient, which costs little more."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, target_moments: Tensor) -> Tensor:
        """Mean SSIM (float32 scalar) of image and target [H, W, C], given the target's moments [2 C, H, W]."""
        x, y = image.detach().contiguous().numpy(), target.numpy()
        moments = ssim_kernels.blur(ssim_kernels.products(x, y), WINDOW)
        sums, derivative = ssim_kernels.similarity(moments, target_moments.numpy())
        if ctx.needs_input_grad[0]:
            blurred = ssim_kernels.blur(derivative, WINDOW)
            ctx.gradient = torch.from_numpy(ssim_kernels.assemble(x, y, blurred, 1 / x.size))
        return torch.tensor(sums.sum() / x.size, dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Gradient of the image [H, W, C] from that of the mean SSIM (scalar); none for the target."""
        return ctx.gradient * gradients[0], None, None


def ssim_torch(image: Tensor, target: Target) -> Tensor:
    """`ssim` of image [H, W, C] by torch convolutions, for CUDA; tests compare the kernels with it."""
    x, y = image.movedim(-1, 0), target.image.movedim(-1, 0)
    mx, xx, xy = _convolve(torch.cat([x, x * x, x * y])).chunk(3)
    my, yy = target.moments.chunk(2)
    c1, c2 = float(ssim_kernels.C1), float(ssim_kernels.C2)
    numerator = (2 * mx * my + c1) * (2 * (xy - mx * my) + c2)
    denominator = (mx * mx + my * my + c1) * (xx - mx * mx + yy - my * my + c2)
    return (numerator / denominator).mean()


def _convolve(planes: Tensor) -> Tensor:
    """Planes [P, H, W] blurred by the window, with zero padding."""
    window = torch.from_numpy(WINDOW).to(planes)
    rows = torch.nn.functional.conv2d(planes[:, None], window.view(1, 1, 1, -1), padding=(0, ssim_kernels.RADIUS))
    return torch.nn.functional.conv2d(rows, window.view(1, 1, -1, 1), padding=(ssim_kernels.RADIUS, 0))[:, 0]
