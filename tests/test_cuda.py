"""Training and rendering on CUDA against the same on the CPU."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gaussian_scene as truth
import numpy as np
import pytest
import torch
from gaussian_files import outputs, write_inputs
from gaussian_training import TRAIN, image_at, new_scene, psnr
from test_gaussians import coloured_scene, small_cloud
from viewed_scenes import brightening, tumbling, with_every_effect

from stages.deformation.motion_models import TableDeformation
from stages.gaussians import __main__ as gaussians_stage
from stages.gaussians import checkpoint, optimise
from stages.gaussians.densify import GradientRecord, densify
from stages.gaussians.optimise import Trainer
from stages.gaussians.options import GaussiansOptions
from stages.gaussians.ssim import Target, photometric_loss
from stages.render import __main__ as render_stage
from stages.render.options import RenderOptions
from stages.shared import costs
from stages.shared.artifacts import read_json, read_metadata, write_json
from stages.shared.images import read_rgb
from stages.splatting.cloud import Cloud, select
from stages.splatting.gains import Exposure
from stages.splatting.gaussian_model import GaussianScene
from stages.splatting.pose_table import PoseTable
from stages.splatting.shutter import Shutter, expose, moments

CPU = torch.device("cpu")
SIZE = (truth.WIDTH, truth.HEIGHT)
SHOWN, TURNED = 1e-3, 1e-3
"""Of values of colours, 0..1, the most by which all but one in a thousand differ: a splat's alpha of about 1/255 is
drawn by one backend alone. Of gradients, their difference in lengths of the gradient."""


def every_effect_and_a_bending_mover() -> GaussianScene:
    """Round splats have no gradient by their turn, and kernel radii none where all control points move alike."""
    scene, random = with_every_effect(), torch.manual_seed(3)
    assert isinstance(scene.deformation, TableDeformation)
    for values in (scene.deformation.table, scene.gaussians["log_scales"], scene.gaussians["quats"]):
        values.data += 0.1 * torch.randn(values.shape, generator=random)
    return scene


def step_on(
    device: torch.device, make: Callable[[], GaussianScene], count: int, followed: int | None
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """A picture [H, W, 3] of `count` moments, and the gradients of its loss and of ARAP by all that is trained."""
    scene = make().to(device)
    picture = moments(Shutter(0.9, truth.cameras(), np.tile(truth.K, (truth.T, 1, 1))), 5, count)
    image, views = expose(scene, picture, *SIZE, followed=followed)
    frame = torch.as_tensor(truth.ray_cast(truth.cameras()[5], truth.TIMES[5])[0], device=device)
    loss = photometric_loss(image, Target(frame), 0.2)[0]
    if scene.deformation is not None:
        loss = loss + 0.01 * scene.deformation.arap_loss(torch.tensor([0.3, 0.7], dtype=torch.float64))
    for view in views:
        view.centres[0].retain_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    centres = {f"centres {k}": view.centres[0].grad for k, view in enumerate(views)}
    found = centres | {name: parameter.grad for name, parameter in scene.named_parameters()}
    return image.detach().cpu().numpy(), {k: g.cpu().numpy() for k, g in found.items() if g is not None}


def differences(
    device: torch.device, make: Callable[[], GaussianScene], count: int, followed: int | None
) -> tuple[float, dict[str, float]]:
    """The colour difference that one pixel in a thousand exceeds, and those of gradients in lengths of the gradient."""
    (image, by_name), (expected, by_cpu) = (step_on(where, make, count, followed) for where in (device, CPU))
    assert by_name.keys() == by_cpu.keys()
    lengths = {name: max(float(np.linalg.norm(gradient)), 1e-9) for name, gradient in by_cpu.items()}  # else rounding
    turned = {name: float(np.linalg.norm(by_name[name] - by_cpu[name])) / lengths[name] for name in by_cpu}
    return float(np.quantile(np.abs(image - expected), 0.999)), turned


@pytest.mark.parametrize(("count", "followed"), [(1, None), (3, None), (3, 1)])
@pytest.mark.parametrize("make", [every_effect_and_a_bending_mover, lambda: tumbling(1.0), brightening])
def test_every_effect_looks_and_trains_as_on_the_cpu(
    make: Callable[[], GaussianScene], count: int, followed: int | None, cuda: torch.device
) -> None:
    shown, turned = differences(cuda, make, count, followed)
    assert shown < SHOWN
    assert {name: error for name, error in turned.items() if not error < TURNED} == {}


def trained_on(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> Trainer:
    monkeypatch.setattr(optimise, "DENSIFY_EVERY", 8)
    seen = truth.observations(TRAIN)
    trainer = Trainer(new_scene(seen).to(device), seen, GaussiansOptions(steps=40), arap_weight=0.01)
    trainer.run(lambda _: None)
    return trainer


def test_a_held_out_frame_is_as_good_as_on_the_cpu(cuda: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nearly. The wall is parallel to the image: which of its splats, all equally deep, is in front is up to rounding,
    and the training of each backend makes the best of its own order."""
    found, expected = trained_on(cuda, monkeypatch), trained_on(CPU, monkeypatch)
    assert found.history.loss[0] == pytest.approx(expected.history.loss[0], rel=0.01)
    frame, _, mask = truth.ray_cast(truth.cameras()[4], truth.TIMES[4])
    images = [image_at(trainer.scene.cpu(), 4) for trainer in (found, expected)]
    for where in (mask, ~mask):
        by_cuda, by_cpu = (psnr(image, frame, where) for image in images)
        assert by_cuda == pytest.approx(by_cpu, abs=1)


def test_density_control_takes_the_same_gaussians(cuda: torch.device) -> None:
    gradient, rows = torch.rand(200, generator=torch.manual_seed(1)) ** 4, torch.arange(200)
    (found, parents), (expected, same) = (
        densify(on(select(small_cloud(), rows), device), gradient.to(device), 230, interval=0.1)
        for device in (cuda, CPU)
    )
    assert parents.tolist() == same.tolist()
    assert (same < 0).any()
    for name, values in vars(expected).items():
        torch.testing.assert_close(getattr(found, name).cpu(), values)


@pytest.mark.parametrize("rows", [None, [0, 2, 3, 7]])
def test_the_record_of_gradients_is_that_of_the_cpu(rows: list[int] | None, cuda: torch.device) -> None:
    records = [GradientRecord.empty(8, device) for device in (cuda, CPU)]
    for seed in range(3):
        gradient = torch.randn(1, 8 if rows is None else len(rows), 2, generator=torch.manual_seed(seed))
        gradient[0, seed] = 0  # not drawn in this step
        for record, device in zip(records, (cuda, CPU), strict=True):
            record.add(gradient.to(device), None if rows is None else torch.tensor(rows, device=device))
    assert records[0].views.tolist() == records[1].views.tolist()
    assert sum(records[1].views.tolist()) == 3 * (gradient.shape[1] - 1)
    torch.testing.assert_close(records[0].mean.cpu(), records[1].mean)


def on(cloud: Cloud, device: torch.device) -> Cloud:
    return Cloud(*(values.to(device) for values in vars(cloud).values()))


def test_a_killed_training_goes_on_where_it_was(cuda: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was captured is there again; sums of CUDA are in no fixed order, so the rest is the same in effect alone."""
    monkeypatch.setattr(optimise, "DENSIFY_EVERY", 8)
    options, seen = GaussiansOptions(steps=40, stride_px=4), truth.observations(TRAIN)
    seen = replace(seen, scene=np.arange(truth.WIDTH) + np.zeros((truth.HEIGHT, 1)) > 9)  # a bar is burnt in
    scenes = coloured_scene(seen), coloured_scene(seen)
    for scene in scenes:
        scene.poses = PoseTable(torch.tensor(seen.times), length=4.0)
        scene.exposure = Exposure(torch.tensor(seen.times), 3)
    straight, resumed = (Trainer(scene.to(cuda), seen, options, arap_weight=0.01) for scene in scenes)
    saved: list[tuple[dict[str, np.ndarray], int]] = []

    def keep(trainer: Trainer) -> None:
        if trainer.step == 21:
            arrays = {name: value.copy() for name, value in checkpoint.capture(trainer).items()}
            saved.append((arrays, trainer.scene.n_static))

    straight.run(keep)
    checkpoint.restore(resumed, *saved[0])
    again = checkpoint.capture(resumed)
    assert all(np.array_equal(again[name], value) for name, value in saved[0][0].items())
    resumed.run(lambda _: None)
    assert resumed.history.loss == pytest.approx(straight.history.loss, rel=0.02)


def test_the_stages_train_and_render_and_the_cpu_renders_the_same(cuda: torch.device, tmp_path: Path) -> None:
    inputs, results = write_inputs(tmp_path), outputs(tmp_path / "out")
    write_json(inputs["scene"], read_json(inputs["scene"]) | {"motion_blur": {"needed": True, "shutter": 0.9}})
    torch.cuda.reset_peak_memory_stats(cuda)
    gaussians_stage.main(**inputs, **results, options=GaussiansOptions(steps=40, device="cuda"))
    assert costs.spent()["gpu_peak_mb"] > 1
    assert abs(read_metadata(results["half"])["psnr_loss_db"]) < 0.1
    folders = [tmp_path / "out" / device for device in ("cuda", "cpu")]
    for folder in folders:
        chosen = RenderOptions(novel_views=3, device="cuda" if folder.name == "cuda" else "cpu")
        files = (inputs["sequence"], inputs["poses"], results["model"], folder, folder.with_suffix(".gif"))
        render_stage.main(*files, chosen)
    names = [sorted(str(path.relative_to(folder)) for path in folder.rglob("*.png")) for folder in folders]
    assert names[0] == names[1]
    assert len(names[0]) == truth.T + 3
    for name in names[0]:
        by_cuda, by_cpu = (read_rgb(folder / name).astype(int) for folder in folders)
        assert np.quantile(np.abs(by_cuda - by_cpu), 0.999) <= 1, name
