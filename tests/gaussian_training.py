"""The scene of gaussian_scene.py in training: what the tests of the Gaussian stage start from."""

import gaussian_scene as truth
import numpy as np
import torch

from stages.gaussians.initial_cloud import initial_cloud
from stages.gaussians.lifting import near_plane_of
from stages.gaussians.optimise import Trainer
from stages.gaussians.options import GaussiansOptions
from stages.gaussians.training_frames import TrainingFrames
from stages.splatting.gaussian_model import GaussianScene

TRAIN = [k for k in range(truth.T) if k != 4]
CANONICAL = TRAIN.index(truth.T // 2)
OPTIONS = GaussiansOptions(steps=40)


def new_scene(seen: TrainingFrames, moving: bool = True) -> GaussianScene:
    motion = truth.true_motion() if moving else None
    cloud = initial_cloud(seen, motion, CANONICAL, stride_px=2, K=4, sh_degree=0)
    background = torch.tensor(seen.images.mean(axis=(0, 1, 2)))
    return GaussianScene(cloud, motion, background, near_plane_of(seen), neighbours=4)


def trained(moving: bool, options: GaussiansOptions = OPTIONS) -> GaussianScene:
    seen = truth.observations(TRAIN)
    trainer = Trainer(new_scene(seen, moving), seen, options, arap_weight=0.01)
    trainer.run(lambda _: None)
    return trainer.scene


@torch.no_grad()
def image_at(scene: GaussianScene, k: int) -> np.ndarray:
    pose, K = torch.tensor(truth.cameras()[k]), torch.tensor(truth.K)
    return scene.render(float(truth.TIMES[k]), pose, K, truth.WIDTH, truth.HEIGHT).colour[0].numpy()


def psnr(image: np.ndarray, expected: np.ndarray, where: np.ndarray) -> float:
    return float(-10 * np.log10(np.square(image.clip(0, 1) - expected)[where].mean()))
