"""Training on frames with motion blur before a camera at rest: longer than the object that moves, and of what rests."""

from dataclasses import replace

import gaussian_scene as truth
import numpy as np
import pytest
import torch
from gaussian_training import psnr

from stages.gaussians.initial_cloud import initial_cloud
from stages.gaussians.lifting import near_plane_of
from stages.gaussians.optimise import Trainer
from stages.gaussians.options import GaussiansOptions
from stages.gaussians.training_frames import TrainingFrames, with_smear
from stages.splatting import shutter
from stages.splatting.gaussian_model import GaussianScene
from stages.splatting.shutter import Shutter

OPEN_FOR, MIDDLE, FINE = 0.9, 4, 16
STEPS = 60


def blurred() -> tuple[TrainingFrames, Shutter]:
    """Frames averaged over FINE moments in linear light, with the depth and masks of their middle."""
    poses = np.tile(truth.cameras()[:1], (truth.T, 1, 1))
    camera = Shutter(OPEN_FOR, poses, np.tile(truth.K, (truth.T, 1, 1)))
    frames = list(range(truth.T))
    seen = replace(truth.observations(frames), cam_from_world=poses)
    images, depths, masks = [], [], []
    for k in frames:
        fine = shutter.moments(camera, k, FINE)
        casts = [truth.ray_cast(pose, time)[0] for time, pose in zip(fine.times, fine.cam_from_world, strict=True)]
        light = shutter.to_linear(torch.tensor(np.stack(casts)).double()).mean(dim=0)
        images.append(shutter.to_display(light).float().numpy())
        _, depth, mask = truth.ray_cast(poses[k], truth.TIMES[k])
        depths.append(depth)
        masks.append(mask)
    return replace(seen, images=np.stack(images), depths=np.stack(depths), masks=np.stack(masks)), camera


def sharp_psnr(seen: TrainingFrames, camera: Shutter | None) -> float:
    """PSNR (dB) of the sharp square in the middle of the clip, after training with or without the shutter."""
    cloud = initial_cloud(seen, truth.true_motion(), MIDDLE, stride_px=1, K=4, sh_degree=0)
    background = torch.tensor(seen.images.mean(axis=(0, 1, 2)))
    scene = GaussianScene(cloud, truth.true_motion(), background, near_plane_of(seen), neighbours=4)
    trained_on = seen if camera is None else with_smear(seen, scene, camera)
    trainer = Trainer(scene, trained_on, GaussiansOptions(steps=STEPS, densify=False), arap_weight=0.01)
    trainer.run(lambda _: None)
    pose, time = seen.cam_from_world[MIDDLE], truth.TIMES[MIDDLE]
    with torch.no_grad():
        view = scene.render(time, torch.tensor(pose), torch.tensor(truth.K), truth.WIDTH, truth.HEIGHT)
    image = view.colour[0].numpy()
    assert np.isfinite(image).all()
    expected, _, mask = truth.ray_cast(pose, time)
    return psnr(image, expected, mask)


def test_blur_longer_than_the_object(monkeypatch: pytest.MonkeyPatch) -> None:
    """A square of 3 px moves by 4 px while the shutter is open: no frame shows its colours unmixed."""
    monkeypatch.setattr(truth, "HALF", 0.04)
    seen, camera = blurred()
    with_it, without = sharp_psnr(seen, camera), sharp_psnr(seen, None)
    assert with_it > without + 1.0


def test_a_shutter_before_what_rests_changes_nothing() -> None:
    """Camera and scene at rest: training is the same, bit for bit."""
    seen, _ = blurred()
    seen = replace(seen, masks=np.zeros_like(seen.masks))
    closed = Shutter(1.0, seen.cam_from_world, seen.Ks)
    images = []
    for camera in (closed, None):
        cloud = initial_cloud(seen, None, MIDDLE, stride_px=4, K=4, sh_degree=0)
        scene = GaussianScene(cloud, None, torch.zeros(3), near_plane_of(seen), neighbours=4)
        trained_on = seen if camera is None else with_smear(seen, scene, camera)
        trainer = Trainer(scene, trained_on, GaussiansOptions(steps=3), arap_weight=0.01)
        trainer.run(lambda _: None)
        images.append(scene.means.detach())
    assert torch.equal(*images)
