"""Hard cases of skinning and its rotations: each fails on the naive formula that it names."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from torch import Tensor

from stages.control import canonical
from stages.deformation import lbs
from stages.deformation.motion_models import TableDeformation
from stages.shared import quaternions

DOUBLE = torch.float64
Arguments = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


def skinning(N: int = 30, P: int = 8, K: int = 4, scale: float = 1.0, dtype: torch.dtype = DOUBLE) -> Arguments:
    """Arguments of `lbs.blend`, with quaternions of random signs, for a scene of size `scale`."""
    generator = torch.Generator().manual_seed(3)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=DOUBLE)

    means, points = scale * normal(N, 3), scale * normal(P, 3)
    index, _ = lbs.neighbours(points, means, K)
    sq_dist = (means[:, None] - points[index]).square().sum(-1)
    weights = lbs.lbs_weights(sq_dist, np.log(scale) + 0.3 * normal(P), index)
    tensors = (means, normal(N, 4), points, quaternions.normalise(normal(P, 4)), scale * normal(P, 3), weights)
    return (*(tensor.to(dtype) for tensor in tensors), index)  # type: ignore[return-value]


def gradients(blend: object, arguments: Arguments) -> list[Tensor]:
    leaves = [tensor.clone().requires_grad_() for tensor in arguments[:6]]
    moved, turned = blend(*leaves, arguments[6])  # type: ignore[operator]
    probe = torch.arange(moved.numel(), dtype=moved.dtype).view_as(moved).sin()
    other = torch.arange(turned.numel(), dtype=moved.dtype).view_as(turned).cos()
    total = (probe * moved).sum() + (other * turned).sum()
    return [moved.detach(), turned.detach(), *torch.autograd.grad(total, leaves)]


@pytest.mark.parametrize(("N", "P", "K"), [(30, 8, 4), (1, 1, 1), (0, 5, 3), (7, 2, 4), (500, 60, 1)])
def test_kernel_agrees_with_torch(N: int, P: int, K: int) -> None:
    arguments = skinning(N, P, K)
    for mine, reference in zip(gradients(lbs.blend, arguments), gradients(lbs.blend_torch, arguments), strict=True):
        torch.testing.assert_close(mine, reference, rtol=1e-10, atol=1e-12)


def test_weights_agree_with_torch() -> None:
    index, sq_dist = lbs.neighbours(torch.rand(9, 3), torch.rand(40, 3), 4)
    log_radii = torch.linspace(-2, 0, 9, requires_grad=True)
    probe = torch.arange(160.0).view(40, 4).sin()
    weights = [function(sq_dist, log_radii, index) for function in (lbs.lbs_weights, lbs.lbs_weights_torch)]
    torch.testing.assert_close(*weights)
    torch.testing.assert_close(*(torch.autograd.grad((probe * some).sum(), log_radii)[0] for some in weights))


def test_kernel_gradients_are_finite_differences() -> None:
    arguments = skinning(6, 5, 3)
    leaves = [tensor.clone().requires_grad_() for tensor in arguments[:6]]
    assert torch.autograd.gradcheck(lambda *tensors: lbs.blend(*tensors, arguments[6]), leaves, atol=1e-6)


def test_blended_values_agree_with_gather() -> None:
    arguments = skinning(50, 9, 4)
    weights, index = arguments[5], arguments[6]
    values, probe = torch.randn(9, 3, dtype=DOUBLE, requires_grad=True), torch.randn(50, 3, dtype=DOUBLE)
    plain = (weights[..., None] * values[index]).sum(1)
    (expected,) = torch.autograd.grad((probe * plain).sum(), values)
    blended = lbs.blend_values(values, weights, index)
    (found,) = torch.autograd.grad((probe * blended).sum(), values)
    torch.testing.assert_close(blended, plain)
    torch.testing.assert_close(found, expected)


def test_weight_gradients_are_finite_differences() -> None:
    index = torch.tensor([[0, 1, 2], [2, 1, 0]])
    sq_dist = torch.tensor([[0.1, 0.5, 2.0], [0.0, 0.3, 0.4]], dtype=DOUBLE, requires_grad=True)
    log_radii = torch.tensor([-0.5, 0.1, 0.4], dtype=DOUBLE, requires_grad=True)
    assert torch.autograd.gradcheck(lambda d, r: lbs.lbs_weights(d, r, index), (sq_dist, log_radii))


@pytest.mark.parametrize("distance", [1e2, 1e4, 1e8])
def test_weights_far_from_every_control_point(distance: float) -> None:
    """exp(-d^2 / 2 sigma^2) / sum is 0 / 0 beyond some 13 radii."""
    points = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0]])
    means = torch.tensor([[distance, 0.0, 0.0]])
    index, sq_dist = lbs.neighbours(points, means, 3)
    log_radii = torch.zeros(3, requires_grad=True)
    naive = torch.exp(-0.5 * sq_dist)
    assert naive.sum() == 0
    weights = lbs.lbs_weights(sq_dist, log_radii, index)
    torch.testing.assert_close(weights.sum(), torch.tensor(1.0))
    assert index[0, weights.argmax()] == 1  # the nearest one carries it
    (gradient,) = torch.autograd.grad(weights[0, 0], log_radii)
    assert torch.isfinite(gradient).all()


def test_coincident_control_points() -> None:
    """Two motions at one place weigh the same; radii and rigidity must not divide by their distance."""
    points = np.zeros((5, 3))
    radii = canonical.kernel_radii(points)
    assert (radii > 0).all()
    some = np.concatenate([np.zeros((3, 3)), np.eye(3), 2 * np.eye(3)])
    assert (canonical.kernel_radii(some) > 0).all()
    index, sq_dist = lbs.neighbours(torch.zeros(2, 3), torch.ones(1, 3), 2)
    weights = lbs.lbs_weights(sq_dist, torch.zeros(2), index)
    torch.testing.assert_close(weights, torch.full((1, 2), 0.5))
    table = TableDeformation(torch.zeros(5, 3), torch.from_numpy(np.log(radii)).float(), torch.linspace(0, 1, 3))
    loss = table.arap_loss(torch.tensor([0.5]))
    loss.backward()
    assert float(loss.detach()) == 0.0
    assert table.table.grad is not None
    assert torch.isfinite(table.table.grad).all()
    assert len(canonical.farthest_points(points, np.ones(5), 4)) == 1


@pytest.mark.parametrize("length", [1e-30, 1e-8, 1.0, 1e18])
def test_quaternions_of_any_length_turn_alike(length: float) -> None:
    """Their squares underflow or overflow float32; dividing by max(|q|, eps) leaves them short."""
    quats = torch.tensor([[0.5, -0.5, 0.5, 0.5], [1.0, 0, 0, 0]])
    torch.testing.assert_close(quaternions.normalise(length * quats), quats)
    arguments = skinning(2, 3, 2, dtype=torch.float32)
    short = (arguments[0], length * quats, *arguments[2:])
    plain = (arguments[0], quats, *arguments[2:])
    for blend in (lbs.blend, lbs.blend_torch):
        torch.testing.assert_close(blend(*short)[1], blend(*plain)[1])


def test_a_zero_quaternion_gives_no_nan() -> None:
    arguments = skinning(3, 3, 2)
    zeroed = (arguments[0], torch.zeros_like(arguments[1]), *arguments[2:])
    for blend in (lbs.blend, lbs.blend_torch):
        assert all(torch.isfinite(result).all() for result in gradients(blend, zeroed))


def test_opposite_signs_are_one_rotation() -> None:
    """The plain mean of q and -q is zero, that of nearly so an arbitrary rotation."""
    arguments = skinning()
    flipped = arguments[3].clone()
    flipped[::2] *= -1
    for blend in (lbs.blend, lbs.blend_torch):
        one, two = blend(*arguments), blend(*arguments[:3], flipped, *arguments[4:])
        torch.testing.assert_close(one[0], two[0])
        aligned = two[1] * (one[1] * two[1]).sum(-1, keepdim=True).sign()
        torch.testing.assert_close(one[1], aligned)
    q = quaternions.normalise(torch.tensor([[0.3, 0.1, -0.7, 0.2]], dtype=DOUBLE))
    pair = (torch.zeros(1, 3, dtype=DOUBLE), torch.tensor([[1.0, 0, 0, 0]], dtype=DOUBLE))
    points, still = torch.zeros(2, 3, dtype=DOUBLE), torch.zeros(2, 3, dtype=DOUBLE)
    weights, index = torch.full((1, 2), 0.5, dtype=DOUBLE), torch.tensor([[0, 1]])
    _, turned = lbs.blend(*pair, points, torch.cat([q, -q]), still, weights, index)
    torch.testing.assert_close(turned, q)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_skinning_does_not_depend_on_the_unit(scale: float) -> None:
    unit, scaled = skinning(dtype=torch.float32), skinning(scale=scale, dtype=torch.float32)
    (moved, turned), (scaled_moved, scaled_turned) = lbs.blend(*unit), lbs.blend(*scaled)
    torch.testing.assert_close(scaled_moved / scale, moved, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(scaled_turned, turned, rtol=1e-4, atol=1e-5)


def test_inverse_blend_undoes_a_rigid_motion_and_reports_strangers() -> None:
    points = torch.randn(20, 3, generator=torch.Generator().manual_seed(5))
    turn = quaternions.normalise(torch.tensor([0.9, 0.2, -0.3, 0.1])).expand(20, 4)
    rotation = quaternions.rotation_matrices(turn[0])
    translations = points @ rotation.T + torch.tensor([1.0, 2.0, 3.0]) - points
    means = 0.8 * torch.randn(50, 3, generator=torch.Generator().manual_seed(6))
    moved = means @ rotation.T + torch.tensor([1.0, 2.0, 3.0])
    found, remoteness = lbs.inverse_blend(moved, points, turn, translations, torch.zeros(20), 4)
    torch.testing.assert_close(found, means, rtol=1e-4, atol=1e-4)
    assert float(remoteness.max()) < 4
    _, far = lbs.inverse_blend(moved + 100, points, turn, translations, torch.zeros(20), 4)
    assert float(far.min()) > 50


def jumbled(turn: float, seed: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Control points in a unit cube with turns of some `turn` each about axes of their own: points, quats,
    translations and log_radii."""
    generator = torch.Generator().manual_seed(seed)
    points, noise = torch.rand(40, 3, generator=generator), torch.randn(40, 4, generator=generator)
    quats = quaternions.normalise(torch.tensor([1.0, 0.0, 0.0, 0.0]) + turn * noise)
    return points, quats, 0.02 * torch.randn(40, 3, generator=generator), torch.full((40,), -1.8)


def test_points_between_control_points_that_turn_apart_have_an_inverse() -> None:
    """Four steps by the least squares of the blended matrix leave 31 % of these points farther off."""
    points, quats, translations, log_radii = jumbled(0.4, seed=0)
    means = torch.rand(2000, 3, generator=torch.Generator().manual_seed(1))
    unturned = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(2000, 4)

    def moved(at: Tensor) -> Tensor:
        index, sq_dist = lbs.neighbours(points, at, 4)
        weights = lbs.lbs_weights(sq_dist, log_radii, index)
        return lbs.blend_torch(at, unturned, points, quats, translations, weights, index)[0]

    seen = moved(means)
    found, _ = lbs.inverse_blend(seen, points, quats, translations, log_radii, 4)
    missed = (moved(found) - seen).norm(dim=-1) / log_radii.exp()[0]
    assert float((missed > 0.5).float().mean()) < 0.12


def test_an_inverse_repeats_wherever_its_work_space_lies() -> None:
    """Least squares by LAPACK round differently on other threads, and trainings did not repeat."""
    for seed in range(20):
        motion = jumbled(0.2, seed)
        moved = torch.rand(5, 3, generator=torch.Generator().manual_seed(seed))
        found = set()
        for _ in range(8):
            with ThreadPoolExecutor(1) as thread:
                inverse, _ = thread.submit(lbs.inverse_blend, moved.clone(), *motion, 4).result()
            found.add(inverse.numpy().tobytes())
        assert len(found) == 1


def test_the_kernel_does_not_depend_on_the_thread_count(monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = skinning(2000, 50, 4, dtype=torch.float32)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    single = gradients(lbs.blend, arguments)
    for threads in ("2", "3"):
        monkeypatch.setenv("OMP_NUM_THREADS", threads)
        for one, many in zip(single, gradients(lbs.blend, arguments), strict=True):
            assert torch.equal(one, many)
