"""Hard cases of the training: frames without texture, masks without or with everything, no Gaussian, any unit."""

from dataclasses import replace

import gaussian_scene as truth
import numpy as np
import pytest
import torch
from gaussian_training import CANONICAL, TRAIN, psnr

from stages.gaussians.densify import densify
from stages.gaussians.initial_cloud import initial_cloud
from stages.gaussians.lifting import near_plane_of
from stages.gaussians.optimise import Trainer
from stages.gaussians.options import GaussiansOptions
from stages.gaussians.training_frames import TrainingFrames, with_movers
from stages.splatting.cloud import select
from stages.splatting.colours import ColourTable
from stages.splatting.gaussian_model import GaussianScene

OPTIONS = GaussiansOptions(steps=12, stride_px=4)


def train(seen: TrainingFrames, unit: float = 1.0) -> GaussianScene:
    """All that the script does: depth of movers, Gaussians, colours over time, a few steps."""
    motion = truth.true_motion(unit)
    carried = with_movers(seen, motion)
    cloud = initial_cloud(carried, motion, CANONICAL, OPTIONS.stride_px, OPTIONS.neighbours, sh_degree=0)
    colours = ColourTable(torch.tensor(seen.times), len(motion.points))
    background = torch.tensor(seen.images.mean(axis=(0, 1, 2)))
    scene = GaussianScene(cloud, motion, background, near_plane_of(seen), OPTIONS.neighbours, colours)
    Trainer(scene, carried, OPTIONS, arap_weight=0.01).run(lambda _: None)
    assert all(torch.isfinite(value).all() for value in scene.state_dict().values())
    return scene


@torch.no_grad()
def image(scene: GaussianScene, k: int, unit: float = 1.0) -> np.ndarray:
    pose, K = torch.tensor(truth.cameras(unit)[k]), torch.tensor(truth.K)
    return scene.render(float(truth.TIMES[k]), pose, K, truth.WIDTH, truth.HEIGHT).colour[0].numpy()


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_black_and_saturated_frames(level: float) -> None:
    """SSIM is 0 / 0 without its constants where nothing varies, and the PSNR of a perfect frame is infinite."""
    seen = truth.observations(TRAIN)
    flat = replace(seen, images=np.full_like(seen.images, level))
    assert np.abs(image(train(flat), 4) - level).max() < 0.1


def test_the_whole_image_masked() -> None:
    """What no control point carries is static, so the wall is not lost with the mask."""
    seen = truth.observations(TRAIN)
    scene = train(replace(seen, masks=np.ones_like(seen.masks)))
    assert 0 < scene.n_static < len(scene.means)
    expected, _, mask = truth.ray_cast(truth.cameras()[4], truth.TIMES[4])
    assert psnr(image(scene, 4), expected, ~mask) > 20


def test_control_points_but_no_mask() -> None:
    seen = truth.observations(TRAIN)
    scene = train(replace(seen, masks=np.zeros_like(seen.masks)))
    assert scene.n_static == len(scene.means)


@pytest.mark.parametrize("unit", [1e-4, 1e4])
def test_training_is_independent_of_the_unit_of_the_scene(unit: float) -> None:
    """Steps are in footprints and extents: raw lengths would leave Adam's steps 1e4 times too long or short."""
    seen = [truth.observations(TRAIN, scale) for scale in (1.0, unit)]
    base, scaled = image(train(seen[0]), 4), image(train(seen[1], unit), 4, unit)
    expected, _, mask = truth.ray_cast(truth.cameras()[4], truth.TIMES[4])
    everywhere = np.ones_like(mask)
    assert psnr(base, expected, everywhere) > 22
    assert abs(psnr(base, expected, everywhere) - psnr(scaled, expected, everywhere)) < 0.3


def test_density_control_without_gaussians() -> None:
    """An empty cloud stays empty, and one that is transparent throughout becomes it."""
    seen = truth.observations(TRAIN)
    cloud = initial_cloud(seen, None, CANONICAL, 8, 4, sh_degree=0)
    empty = select(cloud, torch.zeros(0, dtype=torch.int64))
    assert len(densify(empty, torch.zeros(0), 10, interval=0.1)[0].means) == 0
    cloud.logits[:] = -10
    assert len(densify(cloud, torch.ones(len(cloud.means)), 10_000, interval=0.1)[0].means) == 0
