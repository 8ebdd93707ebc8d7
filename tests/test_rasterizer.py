"""The rasteriser and SSIM against a float64 reference, finite differences and torch convolutions."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from raster_scene import HEIGHT, NAMES, WIDTH, intrinsics, loss, render_kernels, render_reference, scene
from torch import Tensor

from stages.gaussians.ssim import Target, photometric_loss, ssim_torch
from stages.shared.errors import InputError
from stages.splatting import sh
from stages.splatting.drawing_order import drawing_order
from stages.splatting.rasterize import choose_device, rasterize


def gradients(tensors: dict[str, Tensor], kernels: bool) -> dict[str, Tensor]:
    leaves = {name: value.clone().requires_grad_() for name, value in tensors.items()}
    safe = render_reference(tensors).safe
    outputs = render_kernels(leaves) if kernels else render_reference(leaves)[:3]
    loss(*outputs, safe).backward()
    return {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}


def test_image_depth_and_alpha_equal_the_float64_reference() -> None:
    tensors = scene()
    expected = render_reference(tensors)
    assert expected.safe.double().mean() > 0.9
    colour, depth, alpha = render_kernels(tensors)
    assert (colour - expected.colour)[expected.safe].abs().max() < 1e-5
    assert (depth - expected.depth)[expected.safe].abs().max() < 4e-5  # depths reach 4: 1e-5 relative
    assert (alpha - expected.alpha)[expected.safe].abs().max() < 1e-5
    assert (colour - expected.colour).abs().max() < 0.02  # at a threshold no more than one contribution differs


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_gradients_equal_the_float64_reference(seed: int) -> None:
    found, expected = gradients(scene(seed=seed), kernels=True), gradients(scene(seed=seed), kernels=False)
    for name in NAMES:
        error = (found[name] - expected[name]).abs().max() / expected[name].abs().max()
        assert error < 1e-4, f"{name}: {error:.1e}"


def test_reference_gradients_equal_finite_differences() -> None:
    tensors = scene(N=8)
    safe = render_reference(tensors).safe
    expected = gradients(tensors, kernels=False)
    random = np.random.default_rng(1)
    for name in NAMES:
        direction = torch.tensor(random.normal(size=tuple(tensors[name].shape)))
        step = 1e-7
        ends = [tensors | {name: tensors[name] + sign * step * direction} for sign in (1, -1)]
        high, low = (loss(*render_reference(end)[:3], safe) for end in ends)
        slope = (expected[name] * direction).sum()
        assert torch.isclose((high - low) / (2 * step), slope, rtol=1e-4, atol=1e-4), name


def test_centres_carry_the_gradient_of_the_projected_means() -> None:
    tensors = {name: value.float() for name, value in scene().items()}
    viewmat, colours = tensors.pop("viewmat"), tensors.pop("colours")
    tensors["means"].requires_grad_()
    out = rasterize(
        **tensors, colors=colours, viewmats=viewmat[None], Ks=intrinsics()[None], width=WIDTH, height=HEIGHT
    )
    out.centres[0].retain_grad()
    out.colour.sum().backward()
    assert out.centres[0].shape == (1, 60, 2)
    assert out.centres[0].grad is not None
    assert out.centres[0].grad.abs().max() > 0


def test_several_cameras_are_rendered_one_by_one() -> None:
    tensors = {name: value.float() for name, value in scene().items()}
    viewmat, colours = tensors.pop("viewmat"), tensors.pop("colours")
    other = viewmat.clone()
    other[0, 3] += 0.3
    K = intrinsics().float()
    both = rasterize(**tensors, colors=colours, viewmats=torch.stack([viewmat, other]), Ks=torch.stack([K, K]),
                     width=WIDTH, height=HEIGHT)  # fmt: skip
    alone = rasterize(**tensors, colors=colours, viewmats=other[None], Ks=K[None], width=WIDTH, height=HEIGHT)
    assert torch.equal(both.colour[1], alone.colour[0])
    assert not torch.equal(both.colour[0], both.colour[1])


def test_renders_are_equal_bit_for_bit() -> None:
    first, second = gradients(scene(), kernels=True), gradients(scene(), kernels=True)
    assert all(torch.equal(first[name], second[name]) for name in NAMES)


def test_gradients_do_not_depend_on_the_thread_count(monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for threads in ("1", "2", "3"):
        monkeypatch.setenv("OMP_NUM_THREADS", threads)
        found.append(gradients(scene(N=300), kernels=True))
    for other in found[1:]:
        assert all(torch.equal(found[0][name], other[name]) for name in NAMES)


def test_equal_depths_are_drawn_by_index() -> None:
    depths = np.array([2.0, 0.0, 1.0, 2.0, 1.0], np.float32)
    assert drawing_order(depths).tolist() == [2, 4, 0, 3]


def test_drawing_order_is_a_stable_sort_of_what_is_in_front() -> None:
    """Depths of all binary orders, in both signs, many of them equal: each of the passes has bits to sort by."""
    rng = np.random.default_rng(3)
    depths = np.repeat(rng.integers(-(2**31), 2**31, 2000, np.int32).view(np.float32), 2)
    depths = rng.permutation(np.append(depths[np.isfinite(depths)], np.zeros(9, np.float32)))
    order = np.argsort(depths, kind="stable")
    assert drawing_order(depths).tolist() == order[depths[order] > 0].tolist()
    assert drawing_order(np.repeat(depths.astype(float), 2)[::2]).tolist() == drawing_order(depths).tolist()
    assert drawing_order(depths[:0]).dtype == drawing_order(depths).dtype == np.int32


def test_spherical_harmonics_are_orthonormal() -> None:
    """Quadrature over the sphere (exact for these degrees): the Gram matrix is the identity."""
    cosines, weights = np.polynomial.legendre.leggauss(8)
    azimuths = np.arange(16) * 2 * np.pi / 16
    z, phi = np.meshgrid(cosines, azimuths, indexing="ij")
    sine = np.sqrt(1 - z**2)
    directions = torch.tensor(np.stack([sine * np.cos(phi), sine * np.sin(phi), z], axis=-1).reshape(-1, 3))
    solid_angle = torch.tensor(np.repeat(weights * 2 * np.pi / 16, 16))
    values = sh.basis(directions, 3)
    gram = torch.einsum("n,na,nb->ab", solid_angle, values, values)
    assert torch.allclose(gram, torch.eye(16, dtype=gram.dtype), atol=1e-12)


def test_spherical_harmonics_colour_the_render_by_direction() -> None:
    """Degree 1 with only the z harmonic: brighter when seen along +z than along -z (sign of splat files: + C1 z)."""
    coefficients = torch.zeros(1, 4, 3)
    coefficients[0, 2] = 0.4
    along = sh.sh_to_colour(coefficients, torch.tensor([[0.0, 0.0, 1.0]]), 1)
    against = sh.sh_to_colour(coefficients, torch.tensor([[0.0, 0.0, -1.0]]), 1)
    assert torch.allclose(along, torch.full((1, 3), 0.5 + 0.4 * sh.C1))
    assert torch.allclose(against, torch.full((1, 3), 0.5 - 0.4 * sh.C1))
    with pytest.raises(ValueError, match="degree"):
        sh.basis(torch.zeros(1, 3), 4)


def test_colour_survives_its_coefficient() -> None:
    colour = torch.rand(5, 3)
    shown = sh.sh_to_colour(sh.colour_to_sh(colour)[:, None], torch.zeros(5, 3), 0)
    assert torch.allclose(shown, colour, atol=1e-6)


def ssim_reference(x: Tensor, y: Tensor) -> Tensor:
    """SSIM [H, W, C] float64 by direct 2-D convolution."""
    offsets = torch.arange(11, dtype=torch.float64) - 5
    line = torch.exp(-(offsets**2) / 4.5)
    window = torch.outer(line, line) / line.sum() ** 2

    def blur(image: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(image.movedim(-1, 0)[:, None], window[None, None], padding=5)[:, 0].movedim(
            0, -1
        )

    mx, my = blur(x), blur(y)
    sxx, syy, sxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    return (2 * mx * my + 1e-4) * (2 * sxy + 9e-4) / ((mx**2 + my**2 + 1e-4) * (sxx + syy + 9e-4))


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("size", [(37, 53), (3, 4), (9, 33), (64, 16), (66, 21), (150, 21)])
def test_the_loss_and_its_gradient_equal_direct_convolution(size: tuple[int, int], weight: float) -> None:
    random = np.random.default_rng(0)
    target = torch.tensor(random.uniform(size=(*size, 3)))
    image = (target + 0.2 * torch.tensor(random.normal(size=(*size, 3)))).requires_grad_()
    similarity = ssim_reference(image, target).mean()
    expected = (1 - weight) * (image - target).abs().mean() + weight * (1 - similarity)
    (g_expected,) = torch.autograd.grad(expected, image)
    single = image.detach().float().requires_grad_()
    found, squared = photometric_loss(single, Target(target.float()), weight)
    (g_found,) = torch.autograd.grad(3 * found, single)
    assert (found.detach() - expected.detach()).abs() < 1e-6
    assert float(squared) == pytest.approx(float((image - target).detach().square().mean()), rel=1e-5)
    assert (g_found - 3 * g_expected).abs().max() < 1e-4 * (3 * g_expected).abs().max()
    assert (ssim_torch(single.detach(), Target(target.float())) - similarity.detach()).abs() < 1e-6


def test_the_loss_of_an_image_with_itself_is_nothing_and_flat() -> None:
    image = torch.rand(20, 30, 3).requires_grad_()
    value, _ = photometric_loss(image, Target(image.detach()), 0.5)
    (gradient,) = torch.autograd.grad(value, image)
    assert abs(float(value.detach())) < 1e-6
    assert gradient.abs().max() < 1e-5


def test_device_cuda_is_refused_where_there_is_none() -> None:
    if torch.cuda.is_available():
        pytest.skip("this machine has a CUDA device")
    assert choose_device("auto").type == "cpu"
    with pytest.raises(InputError, match="no CUDA device"):
        choose_device("cuda")


@pytest.mark.parametrize("compiled", [True, False])
def test_cuda_is_taken_only_if_gsplat_is_compiled(monkeypatch: pytest.MonkeyPatch, compiled: bool) -> None:
    """Without nvcc gsplat can be imported, but fails at its first render."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name)
    backend = SimpleNamespace(_C=object() if compiled else None)
    for name, module in (
        ("gsplat", SimpleNamespace()),
        ("gsplat.cuda", SimpleNamespace()),
        ("gsplat.cuda._backend", backend),
    ):
        monkeypatch.setitem(sys.modules, name, module)
    assert choose_device("auto").type == ("cuda" if compiled else "cpu")
    assert choose_device("cpu").type == "cpu"
    if not compiled:
        with pytest.raises(InputError, match="nvcc"):
            choose_device("cuda")
