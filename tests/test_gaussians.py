"""Training, labels, density control, checkpoints, views and the two scripts, on a scene with exact truth."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from stages.control.deformation import save_deformation, save_points
from stages.gaussians import checkpoint, optimise, render, train
from stages.gaussians.densify import densify
from stages.gaussians.exposure import Exposure
from stages.gaussians.initialise import cloud_within, dynamic_share, initial_cloud, lift, near_plane_of
from stages.gaussians.inputs import read_observations
from stages.gaussians.model import Cloud, GaussianScene, scene_from_tensors, scene_tensors
from stages.gaussians.observations import Observations, dense_depth, with_movers
from stages.gaussians.optimise import Trainer
from stages.gaussians.options import GaussiansOptions, RenderOptions
from stages.gaussians.skinning import skin, to_canonical
from stages.gaussians.video import MAX_BYTES, write_gif
from stages.gaussians.views import novel_path, right_eye
from stages.shared import lie
from stages.shared.artifacts import read_metadata, read_model, read_table, write_model
from stages.shared.errors import InputError
from stages.shared.images import read_rgb
from stages.shared.split import SplitOptions
from tests import gaussian_scene as truth

TRAIN = [k for k in range(truth.T) if k != 4]
CANONICAL = TRAIN.index(truth.T // 2)
OPTIONS = GaussiansOptions(steps=40)


def new_scene(seen: Observations, moving: bool = True) -> GaussianScene:
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


def test_held_out_frame_is_rendered_and_the_mover_needs_its_motion() -> None:
    expected, _, mask = truth.ray_cast(truth.cameras()[4], truth.TIMES[4])
    moving, static = image_at(trained(moving=True), 4), image_at(trained(moving=False), 4)
    everywhere = np.ones_like(mask)
    assert psnr(moving, expected, everywhere) > 30
    assert psnr(moving, expected, mask) > psnr(static, expected, mask) + 5
    assert psnr(moving, expected, ~mask) > psnr(static, expected, ~mask) - 0.1


def test_static_gaussians_never_move_and_labels_are_right() -> None:
    seen = truth.observations(TRAIN)
    scene = new_scene(seen)
    n = scene.n_static
    assert 0 < n < len(scene.means)
    for time in (0.0, 0.3, 1.0):
        means, quats = scene.at(time)
        assert torch.equal(means[:n], scene.means[:n])
        assert torch.equal(quats[:n], scene.gaussians["quats"][:n])
        offset = means[n:] - torch.tensor(truth.square_centre(time), dtype=torch.float32)
        assert (offset.abs() < truth.HALF + 0.05).all()  # every dynamic Gaussian stays on the square
    assert (scene.means[:n, 2] - truth.WALL_Z).abs().max() < 1e-4  # every static one on the wall


def test_one_false_mask_is_outvoted() -> None:
    """A patch of wall masked in one frame only stays static; the vote counts only frames that see the point."""
    seen = truth.observations(TRAIN)
    seen.masks[0, 50:58, 4:14] = True
    v, u = 54, 8
    keep = np.zeros(seen.masks[0].shape, bool)
    keep[50:58, 4:14] = True
    points = lift(seen, 0, keep, stride_px=2)
    assert len(points.positions) > 10
    assert seen.masks[0, v, u]
    assert (dynamic_share(seen, points.positions[None], seen.masks) < 0.5).all()
    scene = new_scene(seen)
    dynamic = scene.means[scene.n_static :].detach().numpy()
    assert (np.abs(dynamic[:, 2] - truth.SQUARE_Z) < 0.05).all()


def test_the_wall_behind_the_mover_is_not_claimed_by_it() -> None:
    seen = truth.observations(TRAIN)
    behind = truth.square_centre(0.5) * (truth.WALL_Z / truth.SQUARE_Z)
    assert dynamic_share(seen, behind[None, None], seen.masks)[0] == 0
    on_square = np.stack([truth.square_centre(time) for time in seen.times])[:, None]
    assert dynamic_share(seen, on_square, seen.masks)[0] == 1


def test_skinning_and_its_inverse() -> None:
    motion = truth.true_motion()
    with torch.no_grad():
        motion.table[..., :4] += 0.05 * torch.randn(motion.table[..., :4].shape, generator=torch.manual_seed(0))
    rest = motion.points + 0.05
    with torch.no_grad():
        moved = skin(rest, 0.9, motion, 4).double().numpy()
    canonical, found = to_canonical(moved, np.full(len(moved), 0.9), motion, 4)
    assert found.all()
    assert np.abs(canonical - rest.numpy()).max() < 1e-3


def test_a_wholly_masked_image_keeps_what_no_control_point_reaches() -> None:
    seen = truth.observations(TRAIN)
    seen.masks[:] = True
    kept = with_movers(seen, truth.true_motion())
    square = truth.observations(TRAIN).masks
    assert kept.masks[square].all()
    assert not kept.masks[:, :, :8].any()
    motion = truth.true_motion()
    cloud = initial_cloud(kept, motion, CANONICAL, stride_px=2, K=4, sh_degree=0)
    scene = GaussianScene(cloud, motion, torch.zeros(3), near_plane_of(kept), neighbours=4)
    expected, _, mask = truth.ray_cast(truth.cameras()[0], truth.TIMES[0])
    assert psnr(image_at(scene, 0), expected, np.ones_like(mask)) > 20


def test_depth_of_a_slanted_plane_is_exact_and_edges_follow_the_image() -> None:
    s, (height, width) = 4, (64, 96)
    u = np.arange(width)
    inverse = np.broadcast_to(0.2 + 0.002 * u, (height, width))
    coarse = np.broadcast_to(0.2 + 0.002 * (s * np.arange(width // s) + (s - 1) / 2), (height // s, width // s))
    flat = np.full((height, width, 3), 0.5, np.float32)
    inner = np.s_[12:-12, 12:-12]
    assert np.abs(1 / dense_depth(coarse, flat, s) - inverse)[inner].max() < 1e-4
    step = np.where(u < 50, 1.0, 0.25)  # the edge lies inside a grid cell
    image = np.repeat(np.broadcast_to(np.where(u < 50, 0.9, 0.1), (height, width))[..., None], 3, axis=2)
    coarse_step = np.broadcast_to(step[s // 2 :: s], (height // s, width // s))
    sharp = 1 / dense_depth(coarse_step, image.astype(np.float32), s)
    bilinear = np.interp(u, s * np.arange(width // s) + (s - 1) / 2, step[s // 2 :: s])
    assert np.abs(sharp - step)[inner].mean() < 0.6 * np.abs(bilinear - step)[12:-12].mean()


@pytest.mark.parametrize("unit", [1e-4, 1e4])
def test_depth_of_any_unit_and_of_the_sky(unit: float) -> None:
    coarse = np.random.default_rng(0).uniform(0.2, 1, (16, 24)) / unit
    coarse[:4] = 0  # infinitely far
    depth = dense_depth(coarse, np.full((64, 96, 3), 0.5, np.float32), 4)
    assert np.isfinite(depth).all()
    assert depth.min() > 0.9 * unit
    assert depth.max() < 2e4 * unit


def test_guessed_depth_of_movers_comes_from_the_control_points() -> None:
    seen = truth.observations(TRAIN)
    seen.depths[seen.masks] = 4.0  # what a fill from the background would give
    seen.guessed[:] = True
    repaired = with_movers(seen, truth.true_motion())
    expected = truth.observations(TRAIN).depths
    assert np.abs(repaired.depths / expected - 1)[seen.masks].max() < 0.01
    assert np.array_equal(repaired.depths[~seen.masks], seen.depths[~seen.masks])


def test_the_cap_raises_the_stride() -> None:
    seen = truth.observations(TRAIN)
    cloud, stride_px = cloud_within(seen, truth.true_motion(), CANONICAL, 1, 4, 0, max_gaussians=1000)
    assert len(cloud.means) <= 1000
    assert stride_px > 1


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


def test_the_novel_path_circles_and_keeps_its_point() -> None:
    poses = truth.cameras()
    times = np.linspace(0, 1, 9)
    path = novel_path(poses, times, radius=0.1, distance=3.0)
    assert np.allclose(path[0], poses[0])
    assert np.allclose(path[-1], poses[-1])
    on_path = novel_path(poses, times, radius=0.0, distance=3.0)
    target = lie.inverse(on_path)[:, :3, :3] @ [0, 0, 3.0] + lie.inverse(on_path)[:, :3, 3]
    seen_at = np.einsum("nij,nj->ni", path[:, :3, :3], target) + path[:, :3, 3]
    assert np.abs(seen_at[:, :2] / seen_at[:, 2:]).max() < 1e-3
    moved = np.linalg.norm((lie.inverse(path) - lie.inverse(on_path))[:, :3, 3], axis=-1)
    assert moved.max() == pytest.approx(0.1, abs=0.02)


def test_the_right_eye_is_the_same_under_any_similarity() -> None:
    random = np.random.default_rng(0)
    left = lie.exp_se3(random.normal(scale=0.3, size=(6, 6)))
    baseline = lie.from_parts(np.eye(3), np.array([-0.1, 0, 0]))
    rows = np.array([1, 4])
    world = lie.exp_se3(random.normal(size=6))  # our world: turned, shifted and 2.5 times as large
    ours = left @ lie.inverse(world)
    ours[:, :3, 3] = 2.5 * ours[:, :3, 3]
    expected = (baseline @ left @ lie.inverse(world))[rows]
    expected[:, :3, 3] *= 2.5
    assert np.allclose(right_eye(ours, left, (baseline @ left)[rows], rows), expected, atol=1e-12)


def test_the_video_fits_and_has_every_frame(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (12, 436, 1024, 3), dtype=np.uint8)
    write_gif(tmp_path / "video.gif", list(noise), seconds=1.0)
    assert (tmp_path / "video.gif").stat().st_size <= MAX_BYTES
    with Image.open(tmp_path / "video.gif") as video:
        assert getattr(video, "n_frames", 1) == 12


def write_inputs(folder: Path) -> dict[str, Path]:
    truth.write_artifacts(folder)
    save_points(folder / "points.parquet", truth.true_motion(), {})
    save_deformation(folder / "deformation.safetensors", truth.true_motion(), {"canonical_frame": truth.T // 2 + 1})
    names = {"sequence": "sequence.json", "masks": "masks", "poses": "poses.parquet", "depth": "depth.arrow"}
    names |= {"scene": "scene.json", "points": "points.parquet", "deformation": "deformation.safetensors"}
    return {name: folder / file for name, file in names.items()}


def outputs(folder: Path) -> dict[str, Path]:
    names = {"ply": "gaussians.ply", "model": "model.safetensors", "convergence": "convergence.parquet"}
    return {name: folder / file for name, file in (names | {"figure": "figure.png"}).items()}


def test_the_scripts_train_and_render(tmp_path: Path) -> None:
    inputs, results = write_inputs(tmp_path), outputs(tmp_path / "out")
    train.main(**inputs, **results, options=GaussiansOptions(steps=40))
    history = read_table(results["convergence"])
    assert history["step"].tolist() == list(range(1, 41))
    assert history["psnr"][-9:].mean() > history["psnr"][:9].mean() + 2
    assert results["figure"].stat().st_size < 300_000
    assert not list((tmp_path / "out").glob(".*"))  # no checkpoint is left
    renders, video = tmp_path / "out" / "renders", tmp_path / "out" / "video.gif"
    render.main(inputs["sequence"], inputs["poses"], results["model"], renders, video, RenderOptions(novel_views=5))
    found = {split.name: sorted(path.name for path in split.iterdir()) for split in renders.iterdir()}
    assert found["test"] == ["frame_0005.png"]
    assert len(found["train"]) == 9
    assert len(found["novel"]) == 5
    assert "right" not in found
    expected, _, mask = truth.ray_cast(truth.cameras()[4], truth.TIMES[4])
    assert psnr(read_rgb(renders / "test" / "frame_0005.png") / 255, expected, np.ones_like(mask)) > 27


def test_held_out_frames_are_never_opened(tmp_path: Path) -> None:
    inputs = write_inputs(tmp_path)
    paths = {name: inputs[name] for name in ("sequence", "masks", "poses", "depth")}
    before = read_observations(**paths, split=SplitOptions())
    (tmp_path / "frames" / "frame_0005.png").unlink()
    (tmp_path / "masks" / "frame_0005.png").unlink()
    after = read_observations(**paths, split=SplitOptions())
    assert len(after.images) == truth.T - 1
    assert all(np.array_equal(a, b) for a, b in zip(vars(before).values(), vars(after).values(), strict=True))


def test_masks_of_another_size_are_refused(tmp_path: Path) -> None:
    inputs = write_inputs(tmp_path)
    Image.new("L", (10, 10)).save(tmp_path / "masks" / "frame_0002.png")
    paths = {name: inputs[name] for name in ("sequence", "masks", "poses", "depth")}
    with pytest.raises(InputError, match=r"expected 96 x 64, found 10 x 10"):
        read_observations(**paths, split=SplitOptions())
