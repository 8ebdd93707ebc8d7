"""Hard cases of skinning, rotations and rigidity: each fails on the naive formula that it names."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from stages.control import arap, canonical, lbs, quaternions, stage1
from stages.control.arap_kernels import best_rotations
from stages.control.deformation import MLPDeformation, TableDeformation
from stages.control.options import ControlOptions
from stages.control.tracks import Sightings
from stages.shared.cameras import centred_intrinsics, make_cameras, project

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
    loss = arap.arap_loss(table, torch.tensor([0.5]))
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


SINGULAR = {
    "repeated": np.eye(3),
    "two equal": np.diag([2.0, 2.0, 0.5]),
    "plane": np.diag([1.0, 0.5, 0.0]),
    "line": np.diag([1.0, 0.0, 0.0]),
    "point": np.zeros((3, 3)),
    "tiny": 1e-20 * np.diag([3.0, 2.0, 1.0]),
}


@pytest.mark.parametrize("case", SINGULAR)
@pytest.mark.parametrize("mirrored", [False, True])
def test_procrustes_with_repeated_and_zero_singular_values(case: str, mirrored: bool) -> None:
    """A proper rotation always, the true one where the data tell; the derivative of an SVD would be infinite here."""
    turn = Rotation.from_rotvec([0.3, -0.8, 1.1]).as_matrix()
    covariance = torch.from_numpy(SINGULAR[case] @ turn.T)
    if mirrored:
        covariance = covariance @ torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=DOUBLE))
    best = float(torch.trace(arap.procrustes(covariance[None])[0] @ covariance))
    for rotations in (arap.procrustes(covariance[None]), torch.from_numpy(best_rotations(covariance[None].numpy()))):
        R = rotations[0]
        torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=DOUBLE))
        assert float(torch.linalg.det(R)) == pytest.approx(1.0)
        assert float(torch.trace(R @ covariance)) == pytest.approx(best, rel=1e-9, abs=1e-30)
        if not mirrored and case in ("repeated", "two equal", "plane", "tiny"):
            torch.testing.assert_close(R, torch.from_numpy(turn))


def test_rigidity_agrees_with_the_svd() -> None:
    """Random states, a half turn, and a collapse onto a line and onto one point."""
    generator = torch.Generator().manual_seed(1)
    points = torch.randn(15, 3, generator=generator, dtype=DOUBLE)
    line = points * torch.tensor([1.0, 0, 0], dtype=DOUBLE)
    half_turn = points * torch.tensor([-1.0, -1.0, 1.0], dtype=DOUBLE)
    wild = points + torch.randn(15, 3, generator=generator, dtype=DOUBLE)
    graph = arap.arap_graph(points)
    for last in (wild, half_turn, line, torch.zeros_like(points)):
        states = torch.stack([points, wild, last]).requires_grad_()
        energies = [function(states, *graph) for function in (arap.arap_energy, arap.arap_energy_torch)]
        torch.testing.assert_close(*energies)
        if last is wild or last is half_turn:  # a line and a point leave the rotation open, and with it the gradient
            torch.testing.assert_close(*(torch.autograd.grad(energy, states)[0] for energy in energies))


def test_arap_gradient_is_a_finite_difference() -> None:
    """With the rotations held fixed, since they minimise the energy: the envelope theorem."""
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(12, 3, generator=generator, dtype=DOUBLE)
    graph = arap.arap_graph(points)
    moved = (points + 0.3 * torch.randn(12, 3, generator=generator, dtype=DOUBLE)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: arap.arap_energy(torch.stack([points, x]), *graph), (moved,), atol=1e-6)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_skinning_does_not_depend_on_the_unit(scale: float) -> None:
    unit, scaled = skinning(dtype=torch.float32), skinning(scale=scale, dtype=torch.float32)
    (moved, turned), (scaled_moved, scaled_turned) = lbs.blend(*unit), lbs.blend(*scaled)
    torch.testing.assert_close(scaled_moved / scale, moved, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(scaled_turned, turned, rtol=1e-4, atol=1e-5)


def test_one_track_at_the_horizon_does_not_lengthen_the_steps() -> None:
    """Steps in units of the farthest point are 10 px long here: the fit ends far above rest."""
    generator, F = np.random.default_rng(0), 8
    shape = np.concatenate([generator.uniform([-2, -1, 3], [2, 1, 6], (300, 3)), [[1000.0, 0.0, 10000.0]]])
    near = (shape[:, 2] < 4)[:, None, None]
    moved = shape[:, None] + near * np.linspace(-0.2, 0.2, F)[:, None] * np.array([1.0, 0.0, 0.0])
    K = centred_intrinsics(200.0, 256, 192)
    uv, depth = project(moved, np.eye(4), K)
    every = np.ones(depth.shape, bool)
    seen = Sightings(np.arange(F), np.linspace(0, 1, F), uv, every, depth, np.full(depth.shape, 0.02), moved)
    cameras = make_cameras(np.tile(np.eye(4), (F, 1, 1)), K, np.arange(1, F + 1))
    options = ControlOptions(control_points=100, steps=80)
    _, report = stage1.fit_sightings(seen, cameras, {"points": 100, "arap_weight": 0.05}, options)
    assert report["attempts"] == 1
    assert report["median_px"] < 0.2
    assert report["p90_px"] < 1.0


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_models_do_not_depend_on_the_unit(scale: float) -> None:
    generator = torch.Generator().manual_seed(0)
    points, log_radii = torch.randn(9, 3, generator=generator), torch.zeros(9)
    times = torch.tensor([0.2, 0.9])
    for kind in ("table", "mlp"):
        motions, losses = [], []
        for size in (1.0, scale):
            torch.manual_seed(1)
            arguments = size * points, log_radii + float(np.log(size))
            model = (
                TableDeformation(*arguments, torch.linspace(0, 1, 4)) if kind == "table" else MLPDeformation(*arguments)
            )
            with torch.no_grad():
                for name, parameter in model.named_parameters():
                    if name != "log_radii":
                        parameter += 0.05 * torch.randn(parameter.shape)
                motions.append(model(times)[1] / size)
                losses.append(arap.arap_loss(model, times))
        torch.testing.assert_close(*motions, rtol=1e-3, atol=1e-4)
        torch.testing.assert_close(*losses, rtol=1e-2, atol=1e-6)


@pytest.mark.parametrize("N", [0, 1])
def test_no_gaussian_and_one_control_point(N: int) -> None:
    model = TableDeformation(torch.ones(1, 3), torch.zeros(1), torch.tensor([0.0, 1.0]))
    means, quats = torch.zeros(N, 3), torch.tensor([[1.0, 0, 0, 0]]).repeat(N, 1)
    index, sq_dist = lbs.neighbours(model.points, means, 4)
    point_quats, translations = model(torch.tensor([0.5]))
    weights = lbs.lbs_weights(sq_dist, model.log_radii, index)
    moved, turned = lbs.blend(means, quats, model.points, point_quats[0], translations[0], weights, index)
    assert moved.shape == (N, 3)
    assert turned.shape == (N, 4)
    (moved.sum() + turned.sum() + arap.arap_loss(model, torch.tensor([0.5])) + model.bending()).backward()
    assert model.table.grad is not None
    assert torch.isfinite(model.table.grad).all()
    inverse, remoteness = lbs.inverse_blend(
        means, model.points, point_quats[0].detach(), translations[0].detach(), model.log_radii.detach(), 4
    )
    assert inverse.shape == (N, 3)
    assert remoteness.shape == (N,)


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


def test_the_kernel_does_not_depend_on_the_thread_count() -> None:
    import numba

    arguments = skinning(2000, 50, 4, dtype=torch.float32)
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    single = gradients(lbs.blend, arguments)
    numba.set_num_threads(before)
    for one, many in zip(single, gradients(lbs.blend, arguments), strict=True):
        assert torch.equal(one, many)
