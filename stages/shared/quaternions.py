"""Quaternions wxyz as torch tensors [..., 4], differentiable and numerically stable for tiny lengths."""

import torch
from torch import Tensor


def normalise(quats: Tensor) -> Tensor:
    """Unit quaternions [..., 4] of quaternions of any length whose largest entry is a normal float.

    Dividing by the largest entry first avoids underflow of the squares, so 1e-30 * q and q have the same result.
    A zero quaternion stays zero, and its gradient passes through unchanged.
    """
    largest = quats.detach().abs().amax(dim=-1, keepdim=True)
    scaled = quats / torch.where(largest > 0, largest, 1.0)
    length = torch.linalg.vector_norm(scaled, dim=-1, keepdim=True)
    return scaled / torch.where(largest > 0, length, 1.0)


def multiply(left: Tensor, right: Tensor) -> Tensor:
    """Hamilton product [..., 4]: the rotation `right` followed by `left`."""
    a, b, c, d = left.unbind(-1)
    e, f, g, h = right.unbind(-1)
    return torch.stack(
        [
            a * e - b * f - c * g - d * h,
            a * f + b * e + c * h - d * g,
            a * g - b * h + c * e + d * f,
            a * h + b * g - c * f + d * e,
        ],
        dim=-1,
    )


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] of unit quaternions [..., 4]."""
    w, x, y, z = quats.unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, dim=-1).reshape(*quats.shape[:-1], 3, 3)
