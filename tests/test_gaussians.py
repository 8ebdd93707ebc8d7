"""Training, density control, resuming, exposure and the model file, on a scene with exact truth."""

from dataclasses import replace
from pathlib import Path

import gaussian_scene as truth
import numpy as np
import pytest
import torch
from gaussian_training import CANONICAL, OPTIONS, TRAIN, image_at, new_scene, psnr, trained

from stages.gaussians import checkpoint, optimise
from stages.gaussians.densify import densify
from stages.gaussians.exposure import Exposure
from stages.gaussians.initialise import initial_cloud
from stages.gaussians.model import Cloud, GaussianScene, scene_from_tensors, scene_tensors
from stages.gaussians.optimise import Trainer
from stages.gaussians.options import GaussiansOptions
from stages.shared.artifacts import read_metadata, read_model, write_model


def test_held_out_frame_is_rendered_and_the_mover_needs_its_motion() -> None:
    expected, _, mask = truth.ray_cast(truth.cameras()[4], truth.TIMES[4])
    moving, static = image_at(trained(moving=True), 4), image_at(trained(moving=False), 4)
    everywhere = np.ones_like(mask)
    assert psnr(moving, expected, everywhere) > 30
    assert psnr(moving, expected, mask) > psnr(static, expected, mask) + 5
    assert psnr(moving, expected, ~mask) > psnr(static, expected, ~mask) - 0.1


def small_cloud(N: int = 200) -> Cloud:
    generator = torch.manual_seed(0)
    return Cloud(
        means=torch.randn(N, 3, generator=generator) * 0.5 + torch.tensor([0.0, 0, 3]),
        footprints=torch.full((N,), 0.05),
        log_scales=torch.randn(N, 3, generator=generator) * 0.5 - 2.5,
        quats=torch.randn(N, 4, generator=generator),
        logits=torch.randn(N, generator=generator),
        sh=torch.rand(N, 1, 3, generator=generator),
        dynamic=torch.arange(N) >= 150,
    )


def test_densify_splits_what_is_pulled_and_prunes_what_is_transparent() -> None:
    cloud = small_cloud()
    cloud.logits[[3, 160]] = -10.0
    gradient = torch.zeros(200)
    gradient[[7, 170]] = 1.0
    grown, parents = densify(cloud, gradient, max_gaussians=1000)
    assert len(grown.means) == 200 - 2 + 2
    assert not grown.dynamic[: int((~grown.dynamic).sum())].any()  # static first
    kept = parents[parents >= 0].tolist()
    assert sorted(kept) == [k for k in range(200) if k not in (3, 7, 160, 170)]
    assert torch.equal(grown.means[parents >= 0], cloud.means[parents[parents >= 0]])
    halves = torch.nonzero(parents < 0)[:, 0]
    assert torch.allclose(grown.means[halves[:2]].mean(0), cloud.means[7], atol=1e-6)
    longest = cloud.log_scales[7].max().exp()
    assert torch.allclose((grown.means[halves[0]] - grown.means[halves[1]]).norm(), longest, rtol=1e-5)


def test_densify_keeps_the_cap() -> None:
    gradient = torch.rand(200, generator=torch.manual_seed(1)) ** 4
    assert len(densify(small_cloud(), gradient, max_gaussians=203)[0].means) == 203
    assert len(densify(small_cloud(), gradient, max_gaussians=10)[0].means) == 200


def test_a_killed_training_resumes_to_the_same_result(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optimise, "DENSIFY_EVERY", 8)
    options = GaussiansOptions(steps=40, stride_px=4)
    seen = truth.observations(TRAIN)
    straight = Trainer(new_scene(seen), seen, options, arap_weight=0.01)
    saved: dict[int, tuple[dict[str, np.ndarray], int]] = {}

    def keep(trainer: Trainer) -> None:
        if trainer.step == 21:
            arrays = {name: value.copy() for name, value in checkpoint.capture(trainer).items()}
            saved[21] = (arrays, trainer.scene.n_static)

    straight.run(keep)
    resumed = Trainer(new_scene(seen), seen, options, arap_weight=0.01)
    checkpoint.restore(resumed, *saved[21])
    assert resumed.step == 21
    resumed.run(lambda _: None)
    assert resumed.history.loss == straight.history.loss
    expected, found = scene_tensors(straight.scene)[0], scene_tensors(resumed.scene)[0]
    assert all(np.array_equal(expected[name], found[name]) for name in expected)


def test_detached_training_leaves_the_motion_alone() -> None:
    options = GaussiansOptions(steps=5, detach=True)
    before = truth.true_motion().state_dict()
    after = trained(True, options).deformation
    assert after is not None
    assert all(torch.equal(before[name], value) for name, value in after.state_dict().items())
    joint = trained(True, GaussiansOptions(steps=5)).deformation
    assert joint is not None
    assert not torch.equal(before["table"], joint.state_dict()["table"])


@pytest.mark.parametrize("sh_degree", [0, 2])
def test_the_model_file_renders_the_same(tmp_path: Path, sh_degree: int) -> None:
    seen = truth.observations(TRAIN)
    cloud = initial_cloud(seen, truth.true_motion(), CANONICAL, 4, 4, sh_degree)
    cloud.sh[:, 1:] = 0.2 * torch.randn(cloud.sh[:, 1:].shape, generator=torch.manual_seed(0))
    exposure = Exposure(torch.tensor(truth.TIMES))
    exposure.log_gains.data[3:] = 0.2
    scene = GaussianScene(cloud, truth.true_motion(), torch.tensor([0.1, 0.2, 0.3]), 0.02, 4, exposure)
    write_model(tmp_path / "model.safetensors", *scene_tensors(scene))
    again = scene_from_tensors(
        read_model(tmp_path / "model.safetensors"), read_metadata(tmp_path / "model.safetensors")
    )
    assert again.sh_degree == sh_degree
    assert np.array_equal(image_at(scene, 7), image_at(again, 7))


def test_exposure_drift_is_compensated_between_frames_too() -> None:
    """The light fades by 40 %: gains per training frame, interpolated at the held-out one."""
    seen = truth.observations(TRAIN)
    fade = 1 - 0.4 * seen.times
    faded = replace(seen, images=(seen.images * fade[:, None, None, None]).astype(np.float32))
    expected = truth.ray_cast(truth.cameras()[4], truth.TIMES[4])[0] * (1 - 0.4 * truth.TIMES[4])
    scores = []
    for exposure in (None, Exposure(torch.tensor(seen.times))):
        scene = new_scene(faded)
        scene.exposure = exposure
        Trainer(scene, faded, OPTIONS, arap_weight=0.0).run(lambda _: None)
        scores.append(psnr(image_at(scene, 4), expected, np.ones(expected.shape[:2], bool)))
    assert scores[1] > scores[0] + 2
    assert exposure is not None
    assert torch.allclose(exposure(0.5), (exposure(0.4) * exposure(0.6)).sqrt(), rtol=0.05)
