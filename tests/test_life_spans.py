"""Life spans of Gaussians: opacity over time, its gradients, density control, files, and what they are for."""

from dataclasses import replace
from pathlib import Path

import gaussian_scene as truth
import numpy as np
import pytest
import torch
from gaussian_training import CANONICAL, TRAIN, image_at, new_scene, psnr

from stages.gaussians import checkpoint
from stages.gaussians.births import birth_frames, movers_stride
from stages.gaussians.densify import densify
from stages.gaussians.initial_cloud import cloud_within, initial_cloud
from stages.gaussians.lifting import near_plane_of
from stages.gaussians.optimise import Trainer
from stages.gaussians.options import GaussiansOptions
from stages.gaussians.training_frames import TrainingFrames
from stages.shared.artifacts import read_metadata, read_model, write_model
from stages.splatting import placed
from stages.splatting.cloud import Cloud
from stages.splatting.gaussian_model import GaussianScene
from stages.splatting.life_spans import ALWAYS, presence
from stages.splatting.model_files import halved, scene_from_tensors, scene_tensors, write_splats
from stages.splatting.ply import read_ply

EVERY, BIRTHS = 3, [0, 3, 5, 8]
"""One training frame in so many is lifted, and which ones these are of nine."""


def fading_scene(seen: TrainingFrames, every: int = EVERY) -> GaussianScene:
    """The wall and the square, whose Gaussians are lifted from one frame in `every`."""
    motion = truth.true_motion()
    cloud = initial_cloud(seen, motion, CANONICAL, stride_px=2, K=4, sh_degree=0, movers_every=every)
    background = torch.tensor(seen.images.mean(axis=(0, 1, 2)))
    return GaussianScene(cloud, motion, background, near_plane_of(seen), neighbours=4)


def single() -> GaussianScene:
    """One Gaussian, born at 0.4, that control points at rest hold in the middle of the picture."""
    motion = truth.true_motion()
    with torch.no_grad():
        motion.table.zero_()
    cloud = Cloud(
        means=torch.tensor([[0.0, 0.0, 2.0]]),
        footprints=torch.ones(1),
        log_scales=torch.full((1, 3), -2.0),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        logits=torch.tensor([1.0]),
        sh=torch.ones(1, 1, 3),
        dynamic=torch.ones(1, dtype=torch.bool),
        births=torch.tensor([0.4]),
        log_spans=torch.tensor([np.log(0.2)], dtype=torch.float32),
    )
    return GaussianScene(cloud, motion, torch.zeros(3), 0.02, neighbours=4)


def alpha_at(scene: GaussianScene, time: float) -> torch.Tensor:
    """Alpha [H, W] from a camera in the origin."""
    return scene.render(time, torch.eye(4).double(), torch.tensor(truth.K), truth.WIDTH, truth.HEIGHT).alpha[0]


def test_presence_is_its_formula_with_its_derivatives() -> None:
    random = np.random.default_rng(0)
    births, log_spans = random.uniform(size=50), random.normal(-2, 1, size=50)
    expected = np.exp(-np.square(0.3 - births) / (2 * np.exp(log_spans) ** 2))
    arguments = [torch.tensor(values, requires_grad=True) for values in (births, log_spans)]
    assert np.allclose(presence(*arguments, 0.3).detach().numpy(), expected, rtol=1e-12)
    assert torch.autograd.gradcheck(lambda b, s: presence(b, s, 0.3), arguments)
    forever = torch.full((50,), ALWAYS)
    assert (presence(torch.tensor(births).float(), forever, 0.3) == 1).all()


@pytest.mark.parametrize("time", [0.4, 0.1, 0.75, 1.0])
def test_alpha_follows_the_formula_over_time(time: float) -> None:
    scene, brightest = single(), 0.0
    with torch.no_grad():
        found = float(alpha_at(scene, time).max())
        brightest = float(alpha_at(scene, 0.4).max())
    assert found == pytest.approx(brightest * np.exp(-((time - 0.4) ** 2) / 0.08), rel=1e-4)
    assert scene.render(time, torch.eye(4), torch.tensor(truth.K), 96, 64).centres[0].shape[1] == 1


def test_the_rasteriser_passes_gradients_on_to_spans() -> None:
    scene = single()

    def middle() -> torch.Tensor:  # far from the outline, where alpha drops to zero
        return alpha_at(scene, 0.6)[28:36, 44:52].sum()

    middle().backward()
    spans, sums = scene.gaussians["log_spans"], []
    for step in (0.01, -0.01):
        with torch.no_grad():
            spans += step
            sums.append(float(middle()))
            spans -= step
    assert spans.grad is not None
    assert float(spans.grad) == pytest.approx((sums[0] - sums[1]) / 0.02, rel=2e-3)


def test_gaussians_drift_from_where_they_are_at_birth() -> None:
    """Control points at rest leave the straight way of a Gaussian through its life as it is."""
    scene = single()
    start, drift = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[0.3, -0.1, 0.2]])
    with torch.no_grad():
        scene.gaussians["drifts"][:] = drift
        for time, spans in ((0.4, 0.0), (0.2, -1.0), (0.7, 1.5)):
            assert torch.allclose(scene.at(time)[0], start + spans * drift, atol=1e-5)
        scene.gaussians["log_spans"][:] = np.log(0.1)
        assert torch.allclose(scene.at(0.9)[0], start + 3.33 * drift, atol=1e-3)  # five spans on, it is gone


def test_what_is_too_transparent_at_a_time_is_left_out_and_nothing_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = fading_scene(truth.observations(TRAIN), every=1)
    with torch.no_grad():
        scene.gaussians["log_spans"][scene.n_static :] = np.log(0.08)
    opacities, rows = scene.opacities_at(float(truth.TIMES[4]))
    assert rows is not None
    assert len(rows) == len(opacities)
    dynamic = len(scene.anchors) - scene.n_static
    assert 0 < len(rows) - scene.n_static < 0.8 * dynamic
    seen = image_at(scene, 4)
    monkeypatch.setattr(placed, "MIN_ALPHA", -1.0)
    assert len(scene.opacities_at(0.5)[0]) == len(scene.anchors)
    assert np.array_equal(image_at(scene, 4), seen)


def test_movers_are_lifted_from_even_frames_within_the_cap() -> None:
    masked = np.full(26, 10)
    assert birth_frames(masked, 3, room=90) == [0, 3, 6, 9, 12, 16, 19, 22, 25]
    assert birth_frames(masked, 3, room=60) == [0, 5, 10, 15, 20, 25]
    assert birth_frames(masked, 3, room=0) == [0, 6, 12, 19, 25]
    assert birth_frames(masked[:5], 1, room=50) == [0, 1, 2, 3, 4]
    assert birth_frames(masked[:2], 1000, room=50) == [0, 1]
    seen, motion = truth.observations(TRAIN), truth.true_motion()
    cloud = initial_cloud(seen, motion, CANONICAL, 2, 4, 0, movers_every=EVERY)
    births = cloud.births[cloud.dynamic].unique().double().numpy()
    assert np.allclose(births, seen.times[BIRTHS], atol=1e-6)
    assert (cloud.log_spans[~cloud.dynamic] == ALWAYS).all()
    spans = cloud.log_spans[cloud.dynamic].exp()
    assert torch.allclose(spans, torch.full_like(spans, 0.75 / 3), rtol=1e-5)  # three gaps over the clip
    for frame in BIRTHS:
        born = (cloud.births - seen.times[frame]).abs() < 1e-6
        assert (born & cloud.dynamic).sum() == pytest.approx(seen.masks[frame].sum(), rel=0.1)
    most = len(cloud.means) - 1
    fitting, _ = cloud_within(seen, motion, CANONICAL, 2, 4, 0, most, EVERY)
    assert len(fitting.means) <= most
    assert fitting.log_spans[fitting.dynamic].max() < ALWAYS


def test_movers_are_lifted_a_pixel_finer_where_there_is_room_for_them() -> None:
    masked, births = np.array([90, 0, 0, 90]), [0, 3]
    assert movers_stride(masked, births, 3, room=60) == 2  # 180 pixels at a stride of 2 are 45 Gaussians
    assert movers_stride(masked, births, 3, room=59) == 3
    assert movers_stride(masked, births, 3, room=-1) == 3  # the static scene alone is too large
    assert movers_stride(masked, births, 1, room=10_000) == 1


def test_a_mover_that_only_frames_between_show_is_lifted_from_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """The square passes by in the third frame alone, and movers are lifted from the first, the fourth and so on."""
    where = truth.square_centre
    monkeypatch.setattr(truth, "square_centre", lambda t: where(t) + 100 * (abs(t - truth.TIMES[TRAIN[2]]) > 1e-6))
    seen = truth.observations(TRAIN)
    assert seen.masks.any(axis=(1, 2)).tolist() == [f == 2 for f in range(len(TRAIN))]
    monkeypatch.undo()
    arguments = (seen, truth.true_motion(), CANONICAL, 2, 4, 0)
    cloud = initial_cloud(*arguments, movers_every=EVERY)
    assert cloud.dynamic.sum() == pytest.approx(seen.masks[2].sum(), rel=0.1)
    assert (cloud.births[cloud.dynamic] - seen.times[2]).abs().max() < 1e-6
    full = initial_cloud(*arguments, movers_every=EVERY, max_gaussians=len(cloud.means) - 1)
    assert not full.dynamic.any()  # nor is the scene lifted more coarsely for it


def test_halves_inherit_life_spans_and_what_hardly_lives_is_pruned() -> None:
    scene = fading_scene(truth.observations(TRAIN))
    cloud, n = scene.cloud(), scene.n_static
    cloud.births = torch.linspace(0, 1, len(cloud.means))
    cloud.log_spans[n:] = torch.linspace(-3, -1, len(cloud.means) - n)
    cloud.log_spans[n + 5] = np.log(1e-4)
    cloud.drifts = torch.randn(len(cloud.means), 3)
    gradient = torch.zeros(len(cloud.means))
    gradient[n + 9] = 1.0
    grown, parents = densify(cloud, gradient, 10**6, interval=0.1)
    assert sorted(parents.tolist()) == [-1, -1, *(k for k in range(len(cloud.means)) if k not in (n + 5, n + 9))]
    kept = parents >= 0
    for name in ("births", "log_spans", "drifts"):
        now, before = getattr(grown, name), getattr(cloud, name)
        assert torch.equal(now[kept], before[parents[kept]])
        assert (now[~kept] == before[n + 9]).all()


def test_files_hold_the_life_spans(tmp_path: Path) -> None:
    scene = fading_scene(truth.observations(TRAIN))
    with torch.no_grad():
        scene.gaussians["log_spans"][scene.n_static :] += 0.3 * torch.randn(len(scene.anchors) - scene.n_static)
        scene.gaussians["drifts"] += 0.5 * torch.randn(len(scene.anchors), 3)
    write_model(tmp_path / "model.safetensors", *scene_tensors(scene))
    tensors, about = read_model(tmp_path / "model.safetensors"), read_metadata(tmp_path / "model.safetensors")
    again, small = scene_from_tensors(tensors, about), scene_from_tensors(*halved(tensors, about))
    n = scene.n_static
    assert torch.equal(small.births[n:], scene.births[n:])  # a clip of 2,000 frames has more times than half precision
    canonical = scene_tensors(new_scene(truth.observations(TRAIN)))[0]
    assert not {"births", "log_spans"} & set(canonical)
    for k in (0, 4, 8):
        assert np.array_equal(image_at(scene, k), image_at(again, k))
        assert psnr(image_at(small, k), image_at(scene, k), np.ones((truth.HEIGHT, truth.WIDTH), bool)) > 40
    time = float(truth.TIMES[4])
    with torch.no_grad():
        scene.gaussians["logits"][0] = 30.0  # in single precision its opacity is 1
    write_splats(tmp_path / "splats.ply", scene, time)
    written = read_ply(tmp_path / "splats.ply")
    assert np.isfinite(written[3]).all()
    with torch.no_grad():
        opacities, rows = scene.opacities_at(time)
        means = scene.at(time)[0][rows]
    assert np.allclose(1 / (1 + np.exp(-written[3])), opacities, atol=1e-6)
    assert np.allclose(written[0], means, atol=1e-6)


def test_a_killed_training_keeps_its_life_spans() -> None:
    seen, options = truth.observations(TRAIN), GaussiansOptions(steps=12)
    straight, saved = Trainer(fading_scene(seen), seen, options, 0.0), []

    def keep(trainer: Trainer) -> None:
        if trainer.step == 6:
            saved.append({name: values.copy() for name, values in checkpoint.capture(trainer).items()})

    straight.run(keep)
    resumed = Trainer(fading_scene(seen), seen, options, 0.0)
    checkpoint.restore(resumed, saved[0], resumed.scene.n_static)
    resumed.run(lambda _: None)
    expected, found = scene_tensors(straight.scene)[0], scene_tensors(resumed.scene)[0]
    assert set(found) == set(expected)
    assert all(np.array_equal(expected[name], found[name]) for name in expected)


def test_a_mover_that_changes_at_once_needs_life_spans() -> None:
    """The square shows its negative from frame 6 on: one cloud for all time is grey there, life spans are not."""
    seen = truth.observations(TRAIN)
    late = (seen.times > truth.TIMES[5] + 1e-6)[:, None, None] & seen.masks
    changed = replace(seen, images=np.where(late[..., None], 1 - seen.images, seen.images).astype(np.float32))
    scores: list[list[float]] = []
    for scene in (new_scene(changed), fading_scene(changed, every=1)):
        Trainer(scene, changed, GaussiansOptions(steps=60), arap_weight=0.0).run(lambda _: None)
        scores.append([])
        for k in (4, 7):  # the first is held out
            image, _, mask = truth.ray_cast(truth.cameras()[k], truth.TIMES[k])
            expected = np.where(mask[..., None] & (k > 5), 1 - image, image)
            scores[-1] += [psnr(image_at(scene, k), expected, region) for region in (mask, ~mask)]
    canonical, fading = scores
    assert min(fading[0] - canonical[0], fading[2] - canonical[2]) > 3
    assert min(fading[1], fading[3]) > 35  # the wall around it stays as it is
