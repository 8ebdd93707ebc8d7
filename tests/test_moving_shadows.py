"""Shadows that pass over the static scene: found where they are, told from other light, followed between frames."""

from dataclasses import replace
from pathlib import Path

import gaussian_scene as truth
import numpy as np
import pytest
import torch
from gaussian_training import TRAIN, image_at, new_scene, psnr
from lit_room import drift, lit_room, room

from stages.gaussians import checkpoint, optimise
from stages.gaussians.optimise import Trainer
from stages.gaussians.options import GaussiansOptions
from stages.gaussians.shadows import moving_shadows
from stages.gaussians.training_frames import TrainingFrames
from stages.scene.moving_shadows import DENSITY, decide_moving_shadows, shadow_evidence
from stages.scene.observed import Observed
from stages.scene.photometry import light_evidence
from stages.scene.sightings import sight
from stages.scene.weigh import NOTHING
from stages.shared.artifacts import read_metadata, read_model, write_model
from stages.shared.cameras import pixel_grid, unproject
from stages.splatting.cloud import Cloud
from stages.splatting.gaussian_model import GaussianScene
from stages.splatting.model_files import halved, scene_from_tensors, scene_tensors
from stages.splatting.sh import C0
from stages.splatting.shadows import ShadowTable

BAND, DARK = 0.5, 0.5
"""Half of the width of the band of shadow on the wall, scene units, and what light it leaves."""


def shaded_room(left: float, speed: float, seen: Observed) -> Observed:
    """The frames with a shadow on what lies within .3 of x = left + speed * frame."""
    scene = room()[0]
    frames = zip(scene.depth, scene.cam_from_world, strict=True)
    x = np.stack([unproject(pixel_grid(96, 160), depth, pose, scene.K)[..., 0] for depth, pose in frames])
    middle = left + speed * np.arange(len(x))[:, None, None]
    dark = np.where(np.abs(x - middle) < 0.3, 0.6, 1.0)[..., None]
    return replace(seen, rgb=(seen.rgb * dark).astype(np.float32))


@pytest.mark.parametrize(
    ("speed", "percent", "fog", "moves"),
    [(0.1, 0.0, 0.0, True), (0.1, 15.0, 0.0, True), (0.0, 0.0, 0.0, False), (None, 15.0, 0.0, False),
     (None, 0.0, 0.4, False), (None, 0.0, 0.0, False)],
)  # fmt: skip
def test_a_shadow_is_found_if_it_moves(speed: float | None, percent: float, fog: float, moves: bool) -> None:
    """Beside a gain, too; neither one that rests, nor gains, fog or noise without it."""
    seen = lit_room(fog, gains=drift(percent))
    seen = seen if speed is None else shaded_room(-0.4, speed, seen)
    bought = shadow_evidence(sight(seen, density=DENSITY), light_evidence(sight(seen)).fitted)
    decision = decide_moving_shadows(bought, "auto")
    assert decision["needed"] == moves
    assert decision["interval"][0] <= decision["statistic"] <= decision["interval"][1]


def glossy_room(seen: Observed) -> Observed:
    """The frames with colours that change with the direction from which they are seen."""
    scene = room()[0]
    frames = zip(scene.depth, scene.cam_from_world, strict=True)
    rays = [unproject(pixel_grid(96, 160), depth, pose, scene.K) - np.linalg.inv(pose)[:3, 3] for depth, pose in frames]
    across = np.stack([ray[..., 0] / np.linalg.norm(ray, axis=-1) for ray in rays])
    gloss = 2 * (across - across.mean())[..., None]
    return replace(seen, rgb=(seen.rgb * (1 + gloss)).clip(0, 1).astype(np.float32))


@pytest.mark.parametrize("moves", [False, True])
def test_highlights_are_no_shadows_where_the_view_explains_them(moves: bool) -> None:
    """They are without harmonics; with these a shadow beside them is found still."""
    seen = glossy_room(shaded_room(-0.4, 0.1, lit_room()) if moves else lit_room())
    shown, fitted = sight(seen, density=DENSITY), light_evidence(sight(lit_room())).fitted
    plain, explained = (decide_moving_shadows(shadow_evidence(shown, fitted, degree), "auto") for degree in (0, 1))
    assert plain["needed"]
    assert explained["needed"] == moves


def test_who_asks_for_shadows_or_rules_them_out_decides() -> None:
    assert decide_moving_shadows(NOTHING, "yes")["needed"]
    assert not decide_moving_shadows(NOTHING._replace(saved=100.0, before=200.0, samples=9), "no")["needed"]


def test_a_change_that_one_point_shows_alone_is_no_shadow() -> None:
    """As where texture is misplaced: a point says nothing of its neighbours."""
    shown = sight(lit_room(), density=DENSITY)
    at = np.arange(len(shown.cell)) % 4 == np.arange(len(shown.cell)) // 4 % 4
    colours = shown.colours.copy()
    colours[at, 2:5] *= 0.6
    changed = shown._replace(colours=colours)
    fitted = light_evidence(sight(lit_room())).fitted
    assert shadow_evidence(changed, fitted).size == pytest.approx(0, abs=0.1)
    everywhere = shown._replace(colours=shown.colours * np.where(np.isin(np.arange(8), [2, 3, 4]), 0.6, 1)[:, None])
    assert shadow_evidence(everywhere, fitted).size > 5


def shadow_at(time: float, x: np.ndarray) -> np.ndarray:
    """What light reaches x on the wall: a soft band that goes from left to right."""
    away = np.abs(x + 1.2 - 2.4 * time)
    return np.asarray(1 - DARK * np.clip(1.5 - away / BAND, 0, 1))


def wall_light(k: int) -> np.ndarray:
    """The light [H, W] of frame k on the wall; what moves before it is not shaded."""
    pose = truth.cameras()[k]
    _, depth, mask = truth.ray_cast(pose, truth.TIMES[k])
    x = unproject(pixel_grid(truth.HEIGHT, truth.WIDTH), depth, pose, truth.K)[..., 0]
    return np.asarray(np.where(mask, 1.0, shadow_at(truth.TIMES[k], x)))


def shaded_frames(gains: np.ndarray | float = 1.0) -> TrainingFrames:
    seen = truth.observations(TRAIN)
    light = np.stack([wall_light(k) for k in TRAIN])[..., None]
    gains = np.broadcast_to(gains, len(TRAIN))[:, None, None, None]
    return replace(seen, images=(seen.images * light * gains).astype(np.float32))


def test_the_light_on_the_wall_is_found_before_training() -> None:
    seen = shaded_frames()
    cloud = new_scene(seen).cloud()
    table = moving_shadows(seen, cloud)
    assert table is not None
    light = np.stack([shadow_at(time, table.points[:, 0].numpy()) for time in seen.times])
    brightness = truth.texture(*table.points[:, :2].double().numpy().T, 2).mean(axis=-1)
    change = brightness * (light - np.median(light, axis=0))
    found = C0 * table.table.detach().mean(dim=-1).numpy()
    inner = (np.abs(table.points[:, :2].numpy()) < (1.5, 1.0)).all(axis=1)
    assert inner.sum() > 50
    assert np.median(np.abs(found - change)[:, inner]) < 0.02
    assert np.corrcoef(found[:, inner].ravel(), change[:, inner].ravel())[0, 1] > 0.95


@pytest.mark.parametrize("gains", [1.0, np.linspace(0.7, 1.2, len(TRAIN))])
def test_steady_light_has_no_table(gains: np.ndarray | float) -> None:
    """Under gains of whole frames neither."""
    seen = truth.observations(TRAIN)
    gains = np.broadcast_to(gains, len(TRAIN))[:, None, None, None]
    lit = replace(seen, images=(seen.images * gains).astype(np.float32))
    assert moving_shadows(lit, new_scene(seen).cloud()) is None


def shaded_scene(seen: TrainingFrames) -> GaussianScene:
    scene = new_scene(seen)
    scene.shadows = moving_shadows(seen, scene.cloud())
    scene.bind()
    return scene


def test_a_shadow_is_followed_between_frames() -> None:
    """The held-out frame gains, on the wall; what moves before it keeps its colour."""
    seen = shaded_frames()
    image, _, mask = truth.ray_cast(truth.cameras()[4], truth.TIMES[4])
    expected, scores = image * wall_light(4)[..., None], []
    for scene in (new_scene(seen), shaded_scene(seen)):
        Trainer(scene, seen, GaussiansOptions(steps=120), arap_weight=0.0).run(lambda _: None)
        found = image_at(scene, 4)
        scores.append((psnr(found, expected, ~mask), psnr(found, expected, mask)))
    assert scores[1][0] > scores[0][0] + 4
    assert scores[1][1] > scores[0][1] - 1


def test_the_model_file_keeps_the_shadows(tmp_path: Path) -> None:
    scene = shaded_scene(shaded_frames())
    whole, half = (scene_tensors(scene)[0], scene_tensors(scene)[1]), halved(*scene_tensors(scene))
    write_model(tmp_path / "a.safetensors", *whole)
    again = scene_from_tensors(read_model(tmp_path / "a.safetensors"), read_metadata(tmp_path / "a.safetensors"))
    assert np.array_equal(image_at(scene, 7), image_at(again, 7))
    assert half[0]["shadows.table"].dtype == np.float16
    assert np.abs(image_at(scene, 7) - image_at(scene_from_tensors(*half), 7)).mean() < 0.002
    assert scene.shadows is not None
    scene.shadows.table.data *= 0
    assert np.abs(image_at(scene, 7) - image_at(again, 7)).max() > 0.1


def test_a_killed_training_resumes_with_its_shadows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optimise, "DENSIFY_EVERY", 8)
    seen, saved = shaded_frames(), {}
    straight, resumed = (
        Trainer(shaded_scene(seen), seen, GaussiansOptions(steps=30, stride_px=4), arap_weight=0.01) for _ in range(2)
    )

    def keep(trainer: Trainer) -> None:
        if trainer.step == 21:
            saved[21] = ({name: x.copy() for name, x in checkpoint.capture(trainer).items()}, trainer.scene.n_static)

    straight.run(keep)
    checkpoint.restore(resumed, *saved[21])
    resumed.run(lambda _: None)
    assert resumed.history.loss == straight.history.loss
    expected, found = scene_tensors(straight.scene)[0], scene_tensors(resumed.scene)[0]
    assert all(np.array_equal(expected[name], found[name]) for name in expected)
    assert "shadows.table" in expected


def test_both_ways_to_place_gaussians_have_the_shadows() -> None:
    scene = shaded_scene(shaded_frames())
    kernel, torch_only = scene.placed(0.3), scene.placed_torch(0.3)
    assert torch.allclose(kernel.sh_dc, torch_only.sh_dc, atol=1e-6)
    scene.shadows = None
    assert (scene.placed(0.3).sh_dc - kernel.sh_dc).abs().max() > 0.3


def test_a_shadow_fades_out_around_its_points() -> None:
    """It has nearly all of the change in the middle, and none, without a step, from two radii on."""
    table = ShadowTable(torch.tensor([0.0, 1.0]), torch.tensor([[0.0, 0, 1]]), torch.tensor([0.1]))
    table.table.data += 1.0
    means = torch.tensor([[0.0, 0, 1], [0.1995, 0, 1], [0.201, 0, 1], [5, 0, 1]])
    table.bind(means)
    added = table.added(torch.zeros(4, 1, 3), means, 0.5)[:, 0, 0]
    assert added.tolist() == pytest.approx([1 - np.exp(-2), 0, 0, 0], abs=0.02)
    added.sum().backward()
    assert table.table.grad is not None
    assert bool((table.table.grad[..., 0] > 0).all())


def test_the_kernel_of_weights_equals_torch() -> None:
    """Near the points, between them, where they fade out and beyond."""
    random = torch.manual_seed(3)
    points, means = (torch.rand(n, 3, generator=random) for n in (40, 3000))
    table = ShadowTable(torch.tensor([0.0, 1.0]), points, 0.05 + 0.1 * torch.rand(40, generator=random))
    table.bind(means)
    moved = means + 0.02 * torch.randn(means.shape, generator=random)
    weights, expected = table.weights(moved), table.weights_torch(moved)
    assert torch.allclose(weights, expected, atol=1e-6)
    total = weights.sum(dim=1)
    assert total.min() == 0
    assert total.max() > 0.9


def test_a_scene_without_static_gaussians_has_no_shadows() -> None:
    seen, cloud = truth.observations(TRAIN), new_scene(truth.observations(TRAIN)).cloud()
    moving = Cloud(*(value[cloud.dynamic] for value in vars(cloud).values()))
    assert moving_shadows(seen, moving) is None


def test_a_flicker_of_single_frames_is_no_shadow() -> None:
    """The frames around say nothing of it, as they will say nothing of one that is not trained on."""
    flickering = lit_room().rgb.copy()
    flickering[::2, :, 60:100] *= 0.6
    seen = replace(lit_room(), rgb=flickering)
    assert not decide_moving_shadows(
        shadow_evidence(sight(seen, density=DENSITY), light_evidence(sight(seen)).fitted), "auto"
    )["needed"]


def test_only_what_rests_is_shaded() -> None:
    """A wall behind the square, and the square that passes before it, keep their colours."""
    seen = shaded_frames()
    scene = shaded_scene(seen)
    assert scene.shadows is not None
    n = scene.n_static
    shaded, plain = scene.placed(0.3).sh_dc, new_scene(seen).placed(0.3).sh_dc
    assert torch.equal(shaded[n:], plain[n:])
    assert not torch.equal(shaded[:n], plain[:n])
    hidden = replace(seen, depths=0.5 * seen.depths)  # something else is seen before the wall
    assert moving_shadows(hidden, scene.cloud()) is None


def test_a_shadow_is_learnt() -> None:
    seen, scene = shaded_frames(), shaded_scene(shaded_frames())
    assert scene.shadows is not None
    found = scene.shadows.table.detach().clone()
    scene.shadows.table.data.zero_()
    Trainer(scene, seen, GaussiansOptions(steps=200), arap_weight=0.0).run(lambda _: None)
    learnt = scene.shadows.table.detach()
    assert np.corrcoef(found.numpy().ravel(), learnt.numpy().ravel())[0, 1] > 0.6


def test_the_light_of_a_trained_gaussian_stays_when_its_points_are_found_again() -> None:
    """Without movers, whose points are found again as well."""
    seen, scene, pictures = shaded_frames(), new_scene(shaded_frames(), moving=False), []
    scene.shadows = moving_shadows(seen, scene.cloud())
    scene.bind()

    def draw(trainer: Trainer) -> None:
        pictures[:] = [image_at(trainer.scene, 4)]

    Trainer(scene, seen, GaussiansOptions(steps=60, densify=False), arap_weight=0.0).run(draw)
    assert np.abs(image_at(scene, 4) - pictures[0]).mean() < 2e-4


@pytest.mark.parametrize("what", ["logo", "dark", "clipped"])
def test_what_is_burnt_in_dark_or_clipped_is_no_change_of_light(what: str) -> None:
    seen = truth.observations(TRAIN)
    cloud, images, visible = new_scene(seen).cloud(), seen.images.copy(), None
    if what == "logo":
        visible = np.ones(seen.size, bool)
        visible[20:30, 40:70] = False
        images[:, ~visible] = 1.0
    elif what == "dark":
        images[3:6] *= 0.02
    else:
        images = np.clip(images * np.linspace(0.8, 1.6, len(images))[:, None, None, None], 0, 1)
    table = moving_shadows(replace(seen, images=images.astype(np.float32), scene=visible), cloud)
    assert table is None
