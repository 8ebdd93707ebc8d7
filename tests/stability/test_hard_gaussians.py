"""Hard cases of the rasteriser: extreme shapes, planes, opacities and units stay finite and right."""

import numpy as np
import pytest
import reference_rasterizer as reference
import torch
from torch import Tensor

from stages.splatting import projection_kernels
from stages.splatting.rasterize import Rendering, rasterize

WIDTH, HEIGHT = 48, 40
NAMES = ("means", "quats", "scales", "opacities", "colors")


def camera() -> Tensor:
    return torch.tensor([[50.0, 0, 23.5], [0, 50, 19.5], [0, 0, 1]], dtype=torch.float64)


def gaussians(means: list, scales: list, opacities: list, quats: list | None = None) -> dict[str, Tensor]:
    N = len(means)
    colors = np.random.default_rng(0).uniform(0.2, 1, (N, 3))
    values = (np.reshape(means, (N, 3)), quats or [[1.0, 0, 0, 0]] * N, np.reshape(scales, (N, 3)), opacities, colors)
    shaped = [np.reshape(value, (N, *shape)) for value, shape in zip(values, ((3,), (4,), (3,), (), (3,)), strict=True)]
    return {name: torch.tensor(value, dtype=torch.float64) for name, value in zip(NAMES, shaped, strict=True)}


def render(tensors: dict[str, Tensor], near_plane: float = 0.01, background: Tensor | None = None) -> Rendering:
    single = {name: value.float() for name, value in tensors.items()}
    backgrounds = None if background is None else background.float()[None]
    viewmats = torch.eye(4, dtype=torch.float64)[None]
    Ks = camera()[None]
    return rasterize(
        **single, viewmats=viewmats, Ks=Ks, width=WIDTH, height=HEIGHT, near_plane=near_plane, backgrounds=backgrounds
    )


def exact(tensors: dict[str, Tensor], near_plane: float = 0.01) -> reference.Reference:
    values = [tensors[name] for name in NAMES]
    return reference.render(*values, torch.eye(4, dtype=torch.float64), camera(), WIDTH, HEIGHT, near_plane)


def check(tensors: dict[str, Tensor], tolerance: float = 1e-5) -> None:
    """The image equals the float64 reference and every gradient is finite and equal to the reference's."""
    expected = exact(tensors)
    assert expected.safe.double().mean() > 0.8
    leaves = {name: value.clone().requires_grad_() for name, value in tensors.items()}
    twins = {name: value.clone().requires_grad_() for name, value in tensors.items()}
    found = render(leaves)
    assert (found.colour[0] - expected.colour)[expected.safe].abs().max() < tolerance
    weights = torch.tensor(np.random.default_rng(3).normal(size=(HEIGHT, WIDTH, 3))) * expected.safe[..., None]
    (found.colour[0].double() * weights).sum().backward()
    (exact(twins).colour * weights).sum().backward()
    for name in NAMES:
        g_found, g_expected = leaves[name].grad, twins[name].grad
        assert g_found is not None
        assert g_expected is not None
        assert torch.isfinite(g_found).all(), name
        assert (g_found - g_expected).abs().max() <= 10 * tolerance * g_expected.abs().max() + 1e-7, name


def test_needles() -> None:
    """Aspect 1e5 at an angle: a d - b^2 in float32 loses the determinant of their covariance."""
    half_angle = 0.5 * np.deg2rad([37.0, 141.0])
    quats = [[np.cos(a), 0, 0, np.sin(a)] for a in half_angle]
    check(gaussians([[0, 0, 2], [0.1, -0.1, 3]], [[20, 2e-4, 2e-4]] * 2, [0.8, 0.6], quats), tolerance=1e-4)


def test_needle_determinant_needs_lagrange() -> None:
    """What the naive form gives for the needle above: the hard case is one."""
    u, v = np.float32([4000.0, 0.01, 0]), np.float32([3010.0, -0.01, 0])
    blur = np.float32(projection_kernels.BLUR)
    a, b, d = u @ u + blur, u @ v, v @ v + blur
    naive = np.float32(a * d) - np.float32(b * b)
    _, _, det, _ = projection_kernels._covariance(tuple(u.astype(float)), tuple(v.astype(float)))
    exact_det = np.linalg.det(np.stack([u, v]).astype(float) @ np.stack([u, v]).T.astype(float) + 0.3 * np.eye(2))
    assert abs(det / exact_det - 1) < 1e-6
    assert abs(float(naive) / exact_det - 1) > 1e-2


def test_pancakes_edge_on_and_face_on() -> None:
    side = [[np.cos(np.pi / 4), 0, np.sin(np.pi / 4), 0]]
    check(gaussians([[0, 0, 2], [0.2, 0, 2.5]], [[0.4, 0.4, 0]] * 2, [0.8, 0.7], [[1.0, 0, 0, 0], *side]))


def test_points_without_extent_show_as_the_blur() -> None:
    check(gaussians([[0, 0, 2], [0.3, 0.2, 2.5]], [[0.0] * 3] * 2, [0.9, 0.5]))


@pytest.mark.parametrize("z", [-2.0, -1e-6, 0.0, 1e-6, 0.01])
def test_behind_and_on_the_near_plane_nothing_is_drawn(z: float) -> None:
    tensors = gaussians([[0, 0, z], [0.01, 0.02, z]], [[0.3] * 3] * 2, [0.9, 0.9])
    leaves = {name: value.requires_grad_() for name, value in tensors.items()}
    found = render(leaves)
    assert found.alpha.abs().max() == 0
    found.colour.sum().backward()
    for leaf in leaves.values():
        assert leaf.grad is not None
        assert leaf.grad.abs().max() == 0


def test_just_before_the_near_plane_and_far_off_the_axis() -> None:
    """The Jacobian explodes towards the image plane; it is taken inside the widened field of view."""
    tensors = gaussians(
        [[0.5, 0.1, 0.0101], [3.0, 2.0, 0.1], [0, 0, 2]], [[0.05] * 3, [0.02] * 3, [0.2] * 3], [0.9] * 3
    )
    check(tensors)


def test_opacity_one_keeps_gradients_finite() -> None:
    """1 / (1 - alpha) is bounded because alpha is: what lies behind an opaque Gaussian still has a gradient."""
    check(gaussians([[0, 0, 2 + 0.1 * k] for k in range(3)], [[0.3] * 3] * 3, [1.0, 1.0, 1.0]), tolerance=1e-4)


def test_transmittance_zero_ends_a_pixel() -> None:
    """A hundred opaque layers: alpha reaches 1 within 1e-4, and the layers behind receive no gradient."""
    tensors = gaussians([[0, 0, 2 + 0.01 * k] for k in range(100)], [[5.0] * 3] * 100, [0.9] * 100)
    tensors["opacities"].requires_grad_()
    found = render(tensors)
    assert found.alpha.min() > 1 - 2e-4
    found.colour.sum().backward()
    gradient = tensors["opacities"].grad
    assert gradient is not None
    assert torch.isfinite(gradient).all()
    assert gradient[:4].abs().min() > 0
    assert gradient[10:].abs().max() == 0


def test_empty_tiles_show_the_background() -> None:
    background = torch.tensor([0.1, 0.6, 0.3])
    found = render(gaussians([[-0.8, -0.6, 2]], [[0.01] * 3], [0.9]), background=background)
    assert torch.equal(found.colour[0, 16:, 16:], background.expand(HEIGHT - 16, WIDTH - 16, 3))
    assert found.alpha[0, :16, :16].max() > 0.1


def test_no_gaussian_at_all() -> None:
    tensors = {name: value[:0].requires_grad_() for name, value in gaussians([[0, 0, 2]], [[1.0] * 3], [0.5]).items()}
    background = torch.tensor([0.1, 0.6, 0.3])
    found = render(tensors, background=background)
    assert torch.equal(found.colour[0], background.expand(HEIGHT, WIDTH, 3))
    found.colour.sum().backward()
    assert tensors["means"].grad is not None
    assert tensors["means"].grad.shape == (0, 3)


def test_one_gaussian() -> None:
    check(gaussians([[0.1, -0.1, 2]], [[0.3, 0.1, 0.2]], [0.7], [[0.8, 0.1, -0.3, 0.5]]))


@pytest.mark.parametrize("unit", [1e-4, 1e4])
def test_the_unit_of_the_scene_does_not_matter(unit: float) -> None:
    """Image equal, gradients by lengths scale with 1 / unit."""
    random = np.random.default_rng(2)
    N = 30
    means, scales = random.uniform([-0.8, -0.7, 1.5], [0.8, 0.7, 3], (N, 3)), np.exp(random.uniform(-4, -1.5, (N, 3)))
    base = gaussians(means.tolist(), scales.tolist(), random.uniform(0.1, 0.9, N).tolist())
    scaled = base | {name: unit * base[name] for name in ("means", "scales")}
    images, gradients = [], []
    for tensors, near_plane in ((base, 0.01), (scaled, 0.01 * unit)):
        means_leaf = tensors["means"].clone().requires_grad_()
        found = render(tensors | {"means": means_leaf}, near_plane)
        found.colour.square().sum().backward()
        assert means_leaf.grad is not None
        images.append(found.colour.detach())
        gradients.append(means_leaf.grad)
    different = (images[0] - images[1]).abs().amax(dim=-1) > 1e-5
    assert different.double().mean() < 0.01  # pixels at the alpha threshold may fall either way
    error = (unit * gradients[1] - gradients[0]).abs().max() / gradients[0].abs().max()
    assert error < 1e-2


@pytest.mark.parametrize("factor", [1e-30, 1e-10, 1e10])
def test_quaternions_of_any_length(factor: float) -> None:
    """1e-30 squared underflows in float32: the length is taken after scaling."""
    base = gaussians([[0, 0, 2]], [[0.4, 0.1, 0.2]], [0.7], [[0.8, 0.1, -0.3, 0.5]])
    scaled = base | {"quats": factor * base["quats"]}
    assert (render(base).colour - render(scaled).colour).abs().max() < 1e-6


def test_a_splat_as_wide_as_a_city_is_binned_once_per_tile() -> None:
    found = render(gaussians([[0, 0, 1.0]], [[1e6] * 3], [0.5]))
    assert (found.alpha - 0.5).abs().max() < 1e-3
