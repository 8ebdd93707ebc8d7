"""Corrections of poses: their exponential, their gradient, and what they repair."""

from dataclasses import replace

import gaussian_scene as truth
import numpy as np
import torch
from gaussian_training import TRAIN, new_scene, psnr

from stages.gaussians.optimise import Trainer
from stages.gaussians.options import GaussiansOptions
from stages.shared import lie
from stages.splatting.model_files import scene_from_tensors, scene_tensors
from stages.splatting.pose_table import PoseTable


def corrections() -> PoseTable:
    """Five frames with twists of some tenths."""
    poses = PoseTable(torch.linspace(0, 1, 5), length=3.0)
    poses.twists.data = 0.2 * torch.randn(5, 6, generator=torch.manual_seed(0))
    return poses


def test_a_correction_is_the_exponential_of_the_twist_and_linear_between_frames() -> None:
    poses = corrections()
    scale = np.array([3.0, 3, 3, 1, 1, 1])
    twists = poses.twists.detach().double().numpy() * scale
    assert np.allclose(poses(0.25).detach().numpy(), lie.exp_se3(twists[1]), atol=1e-9)
    between = lie.exp_se3(0.7 * twists[2] + 0.3 * twists[3])
    assert np.allclose(poses(0.575).detach().numpy(), between, atol=1e-9)


def test_the_gradient_by_the_twist_is_a_finite_difference() -> None:
    poses = corrections().double()
    weights = torch.randn(4, 4, dtype=torch.float64, generator=torch.manual_seed(1))

    def value(twists: torch.Tensor) -> torch.Tensor:
        return (weights * torch.func.functional_call(poses, {"twists": twists}, (0.4,))).sum()

    assert torch.autograd.gradcheck(value, poses.twists)
    at_rest = torch.zeros(5, 6, dtype=torch.float64, requires_grad=True)  # where every training starts
    assert torch.autograd.gradcheck(value, at_rest)


def test_shaken_poses_are_repaired_and_kept_in_the_file() -> None:
    """Every frame is off by half a pixel its own way: with corrections the training frames fit better."""
    seen = truth.observations(TRAIN)
    shake = np.random.default_rng(0).normal(scale=0.5 / truth.K[0, 0], size=(len(TRAIN), 3))
    shaken = lie.from_parts(lie.exp_so3(shake), np.zeros(3)) @ seen.cam_from_world
    scores = []
    for refine in (False, True):
        scene = new_scene(seen)
        if refine:
            scene.poses = PoseTable(torch.tensor(seen.times), float(np.median(seen.depths)))
        trainer = Trainer(scene, replace(seen, cam_from_world=shaken), GaussiansOptions(steps=150), arap_weight=0.01)
        trainer.run(lambda _: None)
        scores.append(np.mean(trainer.history.psnr[-len(TRAIN) :]))
    assert scores[1] > scores[0] + 0.3
    again = scene_from_tensors(*scene_tensors(scene))
    view = (float(truth.TIMES[7]), torch.tensor(truth.cameras()[7]), torch.tensor(truth.K), truth.WIDTH, truth.HEIGHT)
    with torch.no_grad():
        images = [some.render(*view).colour[0].numpy() for some in (scene, again)]
    assert np.array_equal(*images)
    scene.poses = None
    with torch.no_grad():
        bare = scene.render(*view).colour[0].numpy()
    assert psnr(bare, images[0], np.ones(bare.shape[:2], bool)) < 60
