"""Training, density control, resuming, exposure and the model file, on a scene with exact truth."""

from dataclasses import replace
from pathlib import Path

import gaussian_scene as truth
import numpy as np
import pytest
import torch
from gaussian_training import CANONICAL, OPTIONS, TRAIN, image_at, new_scene, psnr, trained
from scipy.ndimage import binary_dilation

from stages.deformation.motion_models import TableDeformation
from stages.gaussians import beginning, checkpoint, optimise
from stages.gaussians.densify import densify
from stages.gaussians.initial_cloud import initial_cloud
from stages.gaussians.optimise import Trainer
from stages.gaussians.options import GaussiansOptions
from stages.gaussians.training_frames import TrainingFrames
from stages.shared.artifacts import read_metadata, read_model, write_model
from stages.splatting.cloud import Cloud
from stages.splatting.colours import ColourTable
from stages.splatting.gains import Exposure
from stages.splatting.gaussian_model import GaussianScene
from stages.splatting.model_files import halved, scene_from_tensors, scene_tensors
from stages.splatting.pose_table import PoseTable


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
    grown, parents = densify(cloud, gradient, 1000, interval=0.1)
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
    assert len(densify(small_cloud(), gradient, 203, interval=0.1)[0].means) == 203
    assert len(densify(small_cloud(), gradient, 10, interval=0.1)[0].means) == 200


def coloured_scene(seen: TrainingFrames) -> GaussianScene:
    """A new scene whose control points may change colour."""
    scene = new_scene(seen)
    assert scene.deformation is not None
    scene.colours = ColourTable(torch.tensor(seen.times), len(scene.deformation.points))
    return scene


def test_a_killed_training_resumes_to_the_same_result(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optimise, "DENSIFY_EVERY", 8)
    options = GaussiansOptions(steps=40, stride_px=4)
    seen = truth.observations(TRAIN)
    scenes = coloured_scene(seen), coloured_scene(seen)
    for scene in scenes:
        scene.poses = PoseTable(torch.tensor(seen.times), length=4.0)
        scene.exposure = Exposure(torch.tensor(seen.times), 3)
    straight = Trainer(scenes[0], seen, options, arap_weight=0.01)
    saved: dict[int, tuple[dict[str, np.ndarray], int]] = {}

    def keep(trainer: Trainer) -> None:
        if trainer.step == 21:
            arrays = {name: value.copy() for name, value in checkpoint.capture(trainer).items()}
            saved[21] = (arrays, trainer.scene.n_static)

    straight.run(keep)
    resumed = Trainer(scenes[1], seen, options, arap_weight=0.01)
    checkpoint.restore(resumed, *saved[21])
    assert resumed.step == 21
    resumed.run(lambda _: None)
    assert resumed.history.loss == straight.history.loss
    expected, found = scene_tensors(straight.scene)[0], scene_tensors(resumed.scene)[0]
    assert all(np.array_equal(expected[name], found[name]) for name in expected)


def test_training_does_not_depend_on_the_thread_count(monkeypatch: pytest.MonkeyPatch) -> None:
    losses, before = [], torch.get_num_threads()
    try:
        for threads in (1, 2, 3):
            monkeypatch.setenv("OMP_NUM_THREADS", str(threads))
            torch.set_num_threads(threads)
            seen = truth.observations(TRAIN)
            trainer = Trainer(coloured_scene(seen), seen, GaussiansOptions(steps=8), arap_weight=0.01)
            trainer.run(lambda _: None)
            losses.append(trainer.history.loss)
    finally:
        torch.set_num_threads(before)
    assert losses[0] == losses[1] == losses[2]


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_frames_are_rendered_with_the_motion_of_their_neighbours(share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """So Gaussians are right between frames as well; what is wrong with the motion of one frame alone does not tell."""
    monkeypatch.setattr(optimise, "LEFT_OUT_SHARE", share)
    monkeypatch.setattr(optimise, "LEARNING_RATES", dict.fromkeys(optimise.LEARNING_RATES, 0.0))
    for rate in ("MOTION_RATE", "RADIUS_RATE", "COLOUR_RATE"):
        monkeypatch.setattr(optimise, rate, 0.0)
    seen, options = truth.observations(TRAIN), GaussiansOptions(steps=len(TRAIN), densify=False)
    right, spoilt = new_scene(seen), new_scene(seen)
    assert isinstance(spoilt.deformation, TableDeformation)
    knot = TRAIN[3]
    with torch.no_grad():
        spoilt.deformation.table[knot, :, 4:] += 0.5
    trainers = [Trainer(scene, seen, options, arap_weight=0.0) for scene in (right, spoilt)]
    step = np.random.default_rng([options.seed, 0]).permutation(len(TRAIN)).tolist().index(3)  # of the first epoch
    for trainer in trainers:
        trainer.run(lambda _: None)
        assert trainer.scene.deformation.left_out is None
    of_right, of_spoilt = (trainer.history.psnr[step] for trainer in trainers)
    assert of_spoilt == pytest.approx(of_right, abs=1e-3) if share else of_spoilt < of_right - 1


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
    exposure = Exposure(torch.tensor(truth.TIMES), 3)
    exposure.log_gains.data[3:] = 0.2
    colours = ColourTable(torch.tensor(truth.TIMES), len(truth.true_motion().points))
    colours.table.data = 0.3 * torch.randn(colours.table.shape, generator=torch.manual_seed(1))
    scene = GaussianScene(cloud, truth.true_motion(), torch.tensor([0.1, 0.2, 0.3]), 0.02, 4, colours, exposure)
    write_model(tmp_path / "model.safetensors", *scene_tensors(scene))
    again = scene_from_tensors(
        read_model(tmp_path / "model.safetensors"), read_metadata(tmp_path / "model.safetensors")
    )
    assert again.sh_degree == sh_degree
    assert np.array_equal(image_at(scene, 7), image_at(again, 7))


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_half_precision_is_independent_of_the_unit_of_the_scene(unit: float) -> None:
    """float16 ends at 65504 and has 6e-8 as its smallest step: positions in raw units overflow or vanish."""
    cloud = small_cloud()
    cloud.means *= unit
    scene = GaussianScene(cloud, None, torch.zeros(3), 0.02 * unit, 4)
    tensors, settings = halved(*scene_tensors(scene))
    again = scene_from_tensors(tensors, settings)
    assert (cloud.means / unit).abs().max() < 10
    assert ((again.means - scene.means).abs() <= scene.means.abs() / 400_000 + 1e-6 * unit).all()  # float16: / 2048
    assert sum(values.nbytes for values in tensors.values()) < 34 * len(cloud.means)


def test_half_precision_holds_what_is_very_far_and_what_is_at_the_origin() -> None:
    """float16 ends at 65504 medians: what is beyond was infinite. If most means are at the origin the median is 0."""
    cloud = small_cloud()
    cloud.means[0] = cloud.means[0] * 1e6
    near = GaussianScene(cloud, None, torch.zeros(3), 0.02, 4)
    tensors, settings = halved(*scene_tensors(near))
    again = scene_from_tensors(tensors, settings).means
    direction = cloud.means[0] / cloud.means[0].norm()
    assert np.isfinite(tensors["means"]).all()
    assert again[0] @ direction > 1e3 * cloud.means[1:].norm(dim=-1).max()
    assert torch.allclose(again[1:], cloud.means[1:], rtol=1e-5)
    cloud.means[0], cloud.means[2:] = cloud.means[1], 0
    tensors, settings = halved(*scene_tensors(GaussianScene(cloud, None, torch.zeros(3), 0.02, 4)))
    assert torch.allclose(scene_from_tensors(tensors, settings).means, cloud.means, rtol=1e-5)


def test_exposure_drift_is_compensated_between_frames_too() -> None:
    """The light fades by 40 %: gains per training frame, interpolated at the held-out one."""
    seen = truth.observations(TRAIN)
    fade = 1 - 0.4 * seen.times
    faded = replace(seen, images=(seen.images * fade[:, None, None, None]).astype(np.float32))
    expected = truth.ray_cast(truth.cameras()[4], truth.TIMES[4])[0] * (1 - 0.4 * truth.TIMES[4])
    scores = []
    for exposure in (None, Exposure(torch.tensor(seen.times), 3)):
        scene = new_scene(faded)
        scene.exposure = exposure
        Trainer(scene, faded, OPTIONS, arap_weight=0.0).run(lambda _: None)
        scores.append(psnr(image_at(scene, 4), expected, np.ones(expected.shape[:2], bool)))
    assert scores[1] > scores[0] + 2
    assert exposure is not None
    assert torch.allclose(exposure(0.5), (exposure(0.4) * exposure(0.6)).sqrt(), rtol=0.05)


def test_a_mover_that_darkens_is_followed_between_frames_and_the_rest_keeps_its_colour() -> None:
    """The square crosses a shadow in mid-clip: a colour per control point and frame, smooth over the held-out time."""
    light = 0.4 + 0.6 * (2 * truth.TIMES - 1) ** 2
    seen = truth.observations(TRAIN)
    shade = np.where(seen.masks, light[TRAIN][:, None, None], 1)[..., None]
    shaded = replace(seen, images=(seen.images * shade).astype(np.float32))
    image, _, mask = truth.ray_cast(truth.cameras()[4], truth.TIMES[4])
    expected = np.where(mask[..., None], light[4] * image, image)
    scores = []
    for scene in (new_scene(shaded), coloured_scene(shaded)):
        Trainer(scene, shaded, GaussiansOptions(steps=120), arap_weight=0.0).run(lambda _: None)
        found = image_at(scene, 4)
        away = ~binary_dilation(mask, iterations=4)
        scores.append((psnr(found, expected, mask), psnr(found, expected, away)))
    assert scores[1][0] > scores[0][0] + 3
    assert scores[1][1] > scores[0][1] - 1


def test_colours_over_time_have_the_gradient_of_their_formula() -> None:
    generator = torch.manual_seed(0)
    index = torch.randint(5, (20, 3), generator=generator)
    weights = torch.softmax(torch.randn(20, 3, dtype=torch.float64, generator=generator), dim=-1)
    colours = ColourTable(torch.linspace(0, 1, 4), 5).double()
    colours.table.data = torch.randn(colours.table.shape, dtype=torch.float64, generator=generator)
    at_knot = (weights[..., None] * colours.table[2][index]).sum(1)
    assert torch.allclose(colours(2 / 3, weights, index), at_knot, atol=1e-7)

    def shown(table: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(colours, {"table": table}, (0.4, weights, index))

    assert torch.autograd.gradcheck(shown, colours.table)


@pytest.mark.parametrize(("exposure", "white_balance", "channels"), [(0, 0, 0), (1, 0, 1), (0, 1, 3), (1, 1, 3)])
def test_only_the_gains_that_are_called_for_are_trained(exposure: int, white_balance: int, channels: int) -> None:
    """One for all channels, or one for each; both come back from the model file, and none leaves no tensor."""
    seen, scene = truth.observations(TRAIN), new_scene(truth.observations(TRAIN))
    needs = {"exposure": {"needed": bool(exposure)}, "white_balance": {"needed": bool(white_balance)}}
    _, gains, _ = beginning.tables_over_time(seen, None, needs, GaussiansOptions())
    assert (0 if gains is None else gains.log_gains.shape[1]) == channels
    if gains is not None:
        gains.log_gains.data = 0.2 * torch.randn(gains.log_gains.shape, generator=torch.manual_seed(0))
    scene.exposure = gains
    tensors, settings = scene_tensors(scene)
    assert any(name.startswith("exposure.") for name in tensors) == bool(channels)
    again = scene_from_tensors(tensors, settings).exposure
    for time in (0.0, 0.37, 1.0) if gains is not None and again is not None else ():
        assert gains(time).shape == (3,)
        assert torch.equal(again(time), gains(time))
        assert (gains(time)[0] == gains(time)[2]) == (channels == 1)
