"""Hard cases of rotations, rigidity and the motion models: each fails on the naive formula that it names."""

import numpy as np
import pytest
import reference_arap
import torch
from scipy.spatial.transform import Rotation
from track_tables import sightings

from stages.control import fitting, stage1
from stages.control.options import ControlOptions
from stages.deformation import arap, lbs
from stages.deformation.arap_kernels import best_rotations
from stages.deformation.motion_models import MLPDeformation, TableDeformation
from stages.shared.cameras import centred_intrinsics, make_cameras, project

DOUBLE = torch.float64


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
    by_svd = reference_arap.procrustes(covariance[None])[0]
    best = float(torch.trace(by_svd @ covariance))
    for R in (by_svd, torch.from_numpy(best_rotations(covariance[None].numpy()))[0]):
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
        energies = [function(states, *graph) for function in (arap.arap_energy, reference_arap.arap_energy)]
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


def test_one_track_at_the_horizon_does_not_lengthen_the_steps() -> None:
    """Steps in units of the farthest point are 10 px long here: the fit ends far above rest."""
    generator, F = np.random.default_rng(0), 8
    shape = np.concatenate([generator.uniform([-2, -1, 3], [2, 1, 6], (300, 3)), [[1000.0, 0.0, 10000.0]]])
    near = (shape[:, 2] < 4)[:, None, None]
    moved = shape[:, None] + near * np.linspace(-0.2, 0.2, F)[:, None] * np.array([1.0, 0.0, 0.0])
    K = centred_intrinsics(200.0, 256, 192)
    uv, depth = project(moved, np.eye(4), K)
    every = np.ones(depth.shape, bool)
    seen = sightings(np.arange(F), np.linspace(0, 1, F), every, uv, depth, np.full(depth.shape, 0.02), moved)
    cameras = make_cameras(np.tile(np.eye(4), (F, 1, 1)), K, np.arange(1, F + 1))
    options = ControlOptions(control_points=100, steps=80)
    _, report = stage1.fit_sightings(seen, cameras, 0.05, options)
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
                losses.append(model.arap_loss(times))
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
    (moved.sum() + turned.sum() + model.arap_loss(torch.tensor([0.5])) + model.bending()).backward()
    assert model.table.grad is not None
    assert torch.isfinite(model.table.grad).all()
    inverse, remoteness = lbs.inverse_blend(
        means, model.points, point_quats[0].detach(), translations[0].detach(), model.log_radii.detach(), 4
    )
    assert inverse.shape == (N, 3)
    assert remoteness.shape == (N,)


def test_a_mover_that_few_frames_see_is_fitted_from_these() -> None:
    """Frames drawn among all of them hold no sighting in many a step: nothing to draw from."""
    F, P = 60, 12
    model = TableDeformation(torch.rand(P, 3) + torch.tensor([0.0, 0.0, 4.0]), torch.zeros(P), torch.linspace(0, 1, F))
    canonical, frames = model.points.detach().clone(), torch.arange(30, 33)
    K = torch.tensor([[200.0, 0.0, 128.0], [0.0, 200.0, 96.0], [0.0, 0.0, 1.0]])
    track, frame = torch.arange(P).repeat(3), frames.repeat_interleave(P)
    moved = canonical[track] + (frame - 31)[:, None] * torch.tensor([0.1, 0.0, 0.0])
    uv = moved[:, :2] / moved[:, 2:] * 200 + K[:2, 2]
    poses, Ks = torch.eye(4).repeat(F, 1, 1), K.repeat(F, 1, 1)
    depth_std = torch.full_like(moved[:, 2], 0.02)
    times = torch.linspace(0, 1, F)
    seen = fitting.TrackPositions(canonical, track, frame, uv, moved[:, 2], depth_std, times, poses, Ks)
    fitting.fit(model, seen, steps=60, learning_rate=0.01, arap_weight=0.0, seed=0)
    report = fitting.residual_report(model, seen)
    assert report["median_px"] < 0.3 * report["at_rest_px"]
