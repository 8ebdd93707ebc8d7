"""Real spherical harmonics of degree 0-3 for view-dependent colour, in the order and signs that splat files use."""

import torch
from torch import Tensor

MAX_DEGREE = 3
C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
C3 = (
    *(-0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154),
    *(-0.4570457994644658, 1.445305721320277, -0.5900435899266435),
)


def coefficients(degree: int) -> int:
    """Number of coefficients (degree + 1)^2 of all harmonics up to `degree`."""
    return (degree + 1) ** 2


def basis(directions: Tensor, degree: int) -> Tensor:
    """Values [N, (degree + 1)^2] of the harmonics at unit directions [N, 3] from the camera to the Gaussian.

    Raises:
        ValueError: for a degree outside 0..3.
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"SH degree must be 0..{MAX_DEGREE}, not {degree}")
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, C0)]
    if degree >= 1:
        values += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        values += [C2[0] * x * y, C2[1] * y * z, C2[2] * (2 * zz - xx - yy), C2[3] * x * z, C2[4] * (xx - yy)]
    if degree >= 3:
        values += [
            C3[0] * y * (3 * xx - yy),
            C3[1] * x * y * z,
            C3[2] * y * (4 * zz - xx - yy),
            C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            C3[4] * x * (4 * zz - xx - yy),
            C3[5] * z * (xx - yy),
            C3[6] * x * (xx - 3 * yy),
        ]
    return torch.stack(values, dim=-1)


def sh_to_colour(sh: Tensor, views: Tensor, degree: int) -> Tensor:
    """Colours [N, 3] >= 0 of coefficients [N, (degree + 1)^2, 3]: max(0, 0.5 + sum_k basis_k sh_k).

    Args:
        views: [N, 3], vectors from the camera to each Gaussian, of any length but zero.
    """
    if degree == 0:
        return (0.5 + C0 * sh.unbind(1)[0]).relu()
    values = basis(torch.nn.functional.normalize(views, dim=-1), degree)
    return (0.5 + torch.einsum("nk,nkc->nc", values, sh[:, : coefficients(degree)])).clamp_min(0)


def colour_to_sh(colour: Tensor) -> Tensor:
    """Constant coefficient [N, 3] whose colour is `colour` [N, 3] from every direction."""
    return (colour - 0.5) / C0
