"""L1 and structural similarity as one differentiable loss: fused numba on the CPU, convolutions on CUDA.

Convention (that of 3DGS): 11 x 11 Gaussian window with sigma 1.5 px, zero padding, C1 = 0.01^2, C2 = 0.03^2 for values
in 0..1, mean over pixels and channels.
"""

from typing import Any

import torch
from torch import Tensor

from stages.gaussians import ssim_kernels

WINDOW = ssim_kernels.WINDOW


class Target:
    """An image [H, W, C] in 0..1 with its blurred moments, computed once for all comparisons with it."""

    def __init__(self, image: Tensor) -> None:
        self.image = image.contiguous()
        if image.is_cuda:
            planes = self.image.movedim(-1, 0)
            self.moments = _convolve(torch.cat([planes, planes * planes]))
        else:
            moments = ssim_kernels.blur(ssim_kernels.squares(self.image.numpy()))
            self.moments = torch.from_numpy(moments)


def photometric_loss(image: Tensor, target: Target, ssim_weight: float) -> tuple[Tensor, Tensor]:
    """(1 - w) x mean absolute difference + w x (1 - mean SSIM), differentiable in `image` [H, W, C], with w in 0..1.

    Also the mean squared difference, without gradient. Both are scalars.
    """
    if image.is_cuda:
        difference = image - target.image
        loss = (1 - ssim_weight) * difference.abs().mean() + ssim_weight * (1 - ssim_torch(image, target))
        return loss, difference.detach().square().mean()
    pair: tuple[Tensor, Tensor] = _Loss.apply(image, target, ssim_weight)  # type: ignore[no-untyped-call]
    return pair


class _Loss(torch.autograd.Function):
    """The loss by the numba kernels. The forward pass also computes the gradient, which every step asks for."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Target, weight: float) -> tuple[Tensor, Tensor]:
        """Loss and mean squared difference, as `photometric_loss`."""
        x, y = image.detach().contiguous().numpy(), target.image.numpy()
        factors = -weight / x.size, (1 - weight) / x.size
        sums, gradient = ssim_kernels.compare(x, y, target.moments.numpy(), *factors)
        ctx.gradient = torch.from_numpy(gradient)
        similar, absolute, squared = sums / x.size
        loss = (1 - weight) * absolute + weight * (1 - similar)
        squared_mean = torch.tensor(squared, dtype=torch.float32)
        ctx.mark_non_differentiable(squared_mean)
        return torch.tensor(loss, dtype=torch.float32), squared_mean

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Gradient of the image [H, W, C] from that of the loss (scalar); none for the target."""
        return ctx.gradient * gradients[0], None, None


def ssim_torch(image: Tensor, target: Target) -> Tensor:
    """Mean SSIM (scalar) of image [H, W, C] and target by torch convolutions: for CUDA, and to compare the kernels."""
    x, y = image.movedim(-1, 0), target.image.movedim(-1, 0)
    mx, xx, xy = _convolve(torch.cat([x, x * x, x * y])).chunk(3)
    my, yy = target.moments[..., : image.shape[1]].chunk(2)
    c1, c2 = float(ssim_kernels.C1), float(ssim_kernels.C2)
    numerator = (2 * mx * my + c1) * (2 * (xy - mx * my) + c2)
    denominator = (mx * mx + my * my + c1) * (xx - mx * mx + yy - my * my + c2)
    return (numerator / denominator).mean()


def _convolve(planes: Tensor) -> Tensor:
    """Planes [P, H, W] blurred by the window, with zero padding."""
    window = torch.from_numpy(WINDOW).to(planes)
    rows = torch.nn.functional.conv2d(planes[:, None], window.view(1, 1, 1, -1), padding=(0, ssim_kernels.RADIUS))
    return torch.nn.functional.conv2d(rows, window.view(1, 1, -1, 1), padding=(ssim_kernels.RADIUS, 0))[:, 0]
