"""Fog in the model: its physics and gradients, the model file, and training through it."""

from dataclasses import replace

import gaussian_scene as truth
import numpy as np
import pytest
import torch
from gaussian_training import OPTIONS, TRAIN, image_at, new_scene, psnr

from stages.gaussians.fog import cleared_of_fog
from stages.gaussians.initial_cloud import initial_cloud
from stages.gaussians.optimise import Trainer
from stages.splatting.atmosphere import DISPLAY_GAMMA, Atmosphere
from stages.splatting.gaussian_model import GaussianScene
from stages.splatting.model_files import halved, scene_from_tensors, scene_tensors

AIRLIGHT = torch.tensor([0.5, 0.6, 0.7])
EXTINCTION = 0.7 / truth.WALL_Z


def veiled(image: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """A picture [H, W, 3] in fog, by the equation of Koschmieder in numpy."""
    v, u = np.indices(depth.shape)
    rays = np.stack([(u - truth.K[0, 2]) / truth.K[0, 0], (v - truth.K[1, 2]) / truth.K[1, 1], np.ones_like(depth)], -1)
    shown = np.exp(-EXTINCTION * depth * np.linalg.norm(rays, axis=-1))[..., None]
    linear = image.astype(float) ** DISPLAY_GAMMA * shown + AIRLIGHT.numpy() * (1 - shown)
    return (linear ** (1 / DISPLAY_GAMMA)).astype(np.float32)


def test_gradients_are_those_of_finite_differences() -> None:
    air = Atmosphere(0.3, AIRLIGHT).double()
    colours = torch.tensor([[0.0, 0.2, 1.0], [0.5, 1.3, 0.05]], dtype=torch.float64).clamp_min(0.02)
    distance = torch.tensor([0.5, 4.0], dtype=torch.float64)
    assert torch.autograd.gradcheck(air, (colours.requires_grad_(), distance.requires_grad_()))


def test_black_in_clear_air_stays_finite() -> None:
    colours = torch.zeros(2, 3, requires_grad=True)
    shown = Atmosphere(1e-9, torch.zeros(3))(colours, torch.tensor([0.0, 1e3]))
    shown.sum().backward()
    assert torch.isfinite(shown).all()
    assert colours.grad is not None
    assert torch.isfinite(colours.grad).all()


@pytest.mark.parametrize(("distance", "error"), [(0.0, 1e-5), (1.0, 1e-4), (5.0, 1e-3)])
def test_clearing_undoes_the_fog(distance: float, error: float) -> None:
    air, colours = Atmosphere(0.3, AIRLIGHT), torch.rand(50, 3, generator=torch.manual_seed(0)).clamp_min(0.05)
    way = torch.full((50,), distance)
    assert (air.cleared(air(colours, way), way) - colours).abs().max() < error
    hidden = torch.full((50,), 200.0)
    assert (air(colours, hidden) - AIRLIGHT ** (1 / DISPLAY_GAMMA)).abs().max() < 1e-5
    assert torch.isfinite(air.cleared(colours, hidden)).all()


def test_training_through_fog_finds_the_colours_behind_it() -> None:
    """Frames in fog: the render has the fog; without it, the wall of the model is the wall in clear air."""
    seen = truth.observations(TRAIN)
    images = np.stack([veiled(image, depth) for image, depth in zip(seen.images, seen.depths, strict=True)])
    foggy, air = replace(seen, images=images), Atmosphere(EXTINCTION, AIRLIGHT)
    motion = truth.true_motion()
    cloud = initial_cloud(cleared_of_fog(foggy, air), motion, 3, 4, 4, 0)
    scene = GaussianScene(cloud, motion, torch.as_tensor(images.mean(axis=(0, 1, 2))), 0.02, 4, atmosphere=air)
    Trainer(scene, foggy, OPTIONS, arap_weight=0.0).run(lambda _: None)
    clear, depth, _ = truth.ray_cast(truth.cameras()[4], truth.TIMES[4])
    everywhere = np.ones(depth.shape, bool)
    assert psnr(image_at(scene, 4), veiled(clear, depth), everywhere) > 30
    scene.atmosphere = None
    assert psnr(image_at(scene, 4), clear, everywhere) > psnr(veiled(clear, depth), clear, everywhere) + 8


def test_fog_is_in_the_model_file_only_where_it_is_modelled() -> None:
    scene = new_scene(truth.observations(TRAIN))
    assert not any(name.startswith("atmosphere.") for name in scene_tensors(scene)[0])
    before = image_at(scene, 4)
    scene.atmosphere = Atmosphere(EXTINCTION, AIRLIGHT)
    after = image_at(scene, 4)
    assert np.abs(after - before).max() > 0.1
    for tensors, settings in (scene_tensors(scene), halved(*scene_tensors(scene))):
        again = scene_from_tensors(tensors, settings)
        assert np.abs(image_at(again, 4) - after).mean() < 1e-3
