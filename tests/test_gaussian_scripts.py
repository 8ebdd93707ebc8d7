"""The scripts gaussians_stage.py and render_stage.py, their inputs, checkpoints, cameras and video."""

from dataclasses import replace
from pathlib import Path

import gaussian_scene as truth
import numpy as np
import pytest
import torch
from gaussian_files import outputs, write_inputs
from gaussian_training import psnr
from PIL import Image

from stages.control import __main__ as control_stage
from stages.control.options import ControlOptions
from stages.gaussians import __main__ as gaussians_stage
from stages.gaussians import checkpoint
from stages.gaussians.beginning import begin
from stages.gaussians.checkpoint import Checkpoint
from stages.gaussians.inputs import read_observations
from stages.gaussians.optimise import Trainer
from stages.gaussians.options import GaussiansOptions
from stages.gaussians.training_frames import TrainingFrames
from stages.render import __main__ as render_stage
from stages.render import view
from stages.render.options import RenderOptions, ViewOptions
from stages.render.video import MAX_BYTES, write_gif
from stages.shared import costs
from stages.shared.artifacts import (
    read_json,
    read_metadata,
    read_model,
    read_table,
    write_json,
    write_model,
    write_table,
)
from stages.shared.cameras import make_cameras, read_cameras, write_cameras
from stages.shared.errors import InputError
from stages.shared.images import read_rgb, to_uint8
from stages.shared.split import SplitOptions
from stages.splatting.model_files import read_scene
from stages.splatting.ply import read_ply
from stages.splatting.rasterize import rasterize
from stages.splatting.shutter import Shutter, expose, instant, moments


def test_the_video_fits_and_has_every_frame(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (12, 436, 1024, 3), dtype=np.uint8)
    write_gif(tmp_path / "video.gif", list(noise), seconds=1.0)
    assert (tmp_path / "video.gif").stat().st_size <= MAX_BYTES
    with Image.open(tmp_path / "video.gif") as video:
        assert getattr(video, "n_frames", 1) == 12


def test_the_scripts_train_and_render(tmp_path: Path) -> None:
    inputs, results = write_inputs(tmp_path), outputs(tmp_path / "out")
    gaussians_stage.main(**inputs, **results, options=GaussiansOptions(steps=40))
    assert read_metadata(results["model"])["status"] == "trained"
    history = read_table(results["convergence"])
    assert history["step"].tolist() == list(range(1, 41))
    assert history["psnr"][-9:].mean() > history["psnr"][:9].mean() + 2
    assert results["figure"].stat().st_size < 300_000
    assert not list((tmp_path / "out").glob(".*"))  # no checkpoint is left
    renders, video = tmp_path / "out" / "renders", tmp_path / "out" / "video.gif"
    chosen = RenderOptions(novel_views=5)
    render_stage.main(inputs["sequence"], inputs["poses"], results["model"], renders, video, chosen)
    found = {split.name: sorted(path.name for path in split.iterdir()) for split in renders.iterdir()}
    assert found["test"] == ["frame_0005.png"]
    assert len(found["train"]) == 9
    assert len(found["novel"]) == 5
    assert "right" not in found
    expected, _, mask = truth.ray_cast(truth.cameras()[4], truth.TIMES[4])
    assert psnr(read_rgb(renders / "test" / "frame_0005.png") / 255, expected, np.ones_like(mask)) > 27
    check_exports(inputs, results, renders, tmp_path / "views")


def test_a_training_too_short_to_see_every_frame_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    inputs = write_inputs(tmp_path)
    begin(*inputs.values(), GaussiansOptions(steps=9), tmp_path)
    assert "training frames" not in caplog.text
    begin(*inputs.values(), GaussiansOptions(steps=8), tmp_path)
    assert "8 steps see as many of 9 training frames" in caplog.text


def test_a_long_clip_is_trained_in_more_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of its frames is seen as often as those of a shorter one."""
    monkeypatch.setattr("stages.gaussians.options.SHORT_CLIP", 4)
    start = begin(*write_inputs(tmp_path).values(), GaussiansOptions(steps=10), tmp_path)
    assert start.trainer.options == GaussiansOptions(steps=23)  # 9 of 4 frames times 10
    start.trainer.run(lambda _: None)
    assert start.trainer.history.step[-1] == 23


@pytest.mark.parametrize(("frames", "steps"), [(2, 400), (40, 400), (41, 410), (43, 430), (875, 8750)])
def test_steps_are_in_proportion_to_the_frames_of_a_long_clip(frames: int, steps: int) -> None:
    """Exactly: 400 * (83 / 80) in floating point is more than 415."""
    assert GaussiansOptions(steps=400).of_length(frames).steps == steps
    assert GaussiansOptions(steps=0).of_length(frames).steps == 0


def test_stage_one_alone_gives_a_scene_that_renders(tmp_path: Path) -> None:
    """No step: what depth, masks and the control points' motion give."""
    inputs, results = write_inputs(tmp_path), outputs(tmp_path / "out")
    gaussians_stage.main(**inputs, **results, options=GaussiansOptions(steps=0))
    assert len(read_table(results["convergence"])["step"]) == 0
    view.main(results["model"], inputs["poses"], tmp_path / "views", ViewOptions(at_time=float(truth.TIMES[4])))
    expected, _, mask = truth.ray_cast(truth.cameras()[4], truth.TIMES[4])
    shown = read_rgb(tmp_path / "views" / "frame_0005.png") / 255
    assert psnr(shown, expected, np.ones_like(mask)) > 18


def check_exports(inputs: dict[str, Path], results: dict[str, Path], renders: Path, views: Path) -> None:
    """Half precision is little over half the size and looks the same; PLY and views show what the renders show."""
    cost = read_metadata(results["half"])
    assert results["half"].stat().st_size < 0.6 * results["model"].stat().st_size
    assert abs(cost["psnr_loss_db"]) < 0.05  # without what float16 leaves of the means it is up to 0.5
    table = read_table(inputs["poses"])
    write_table(
        views / "cameras.parquet", {name: values[4:6] for name, values in table.items()} | {"time": truth.TIMES[4:6]}
    )
    options = ViewOptions(splats=True)
    images = {}
    for name in ("model", "half"):
        view.main(results[name], views / "cameras.parquet", views / name, options)
        images[name] = [read_rgb(views / name / f"frame_000{n}.png") / 255 for n in (5, 6)]
    assert np.array_equal(images["model"][0], read_rgb(renders / "test" / "frame_0005.png") / 255)
    assert np.array_equal(images["model"][1], read_rgb(renders / "train" / "frame_0006.png") / 255)
    assert psnr(images["half"][0], images["model"][0], np.ones(images["half"][0].shape[:2], bool)) > 45
    from_ply = splat_image(views / "model" / "frame_0005.ply", results["model"])
    assert psnr(from_ply, images["model"][0], np.ones(images["half"][0].shape[:2], bool)) > 45
    view.main(results["model"], views / "cameras.parquet", views / "still", ViewOptions(at_time=0.0, width_px=48))
    with Image.open(views / "still" / "frame_0005.png") as still:
        assert still.size == (48, truth.HEIGHT)


def splat_image(path: Path, model: Path) -> np.ndarray:
    """A PLY from the camera of frame 5, over the background of the model."""
    means, quats, log_scales, logits, sh = (torch.tensor(values) for values in read_ply(path))
    camera = torch.tensor(truth.cameras()[4:5]), torch.tensor(truth.K[None])
    background = torch.tensor(read_model(model)["background"])[None]
    view = (*camera, truth.WIDTH, truth.HEIGHT)
    rendered = rasterize(means, quats, log_scales.exp(), logits.sigmoid(), sh, *view, 0, backgrounds=background)
    return rendered.colour[0].numpy()


def test_a_killed_script_leaves_no_result_and_goes_on_from_its_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inputs, options = write_inputs(tmp_path), GaussiansOptions(steps=20, stride_px=4)
    straight, killed = outputs(tmp_path / "straight"), outputs(tmp_path / "killed")
    gaussians_stage.main(**inputs, **straight, options=options)
    monkeypatch.setattr(checkpoint, "INTERVAL_S", 0.0)
    save, steps = Checkpoint.save_sometimes, []

    def save_and_die(self: Checkpoint, trainer: Trainer) -> None:
        save(self, trainer)
        steps.append(trainer.step)
        if steps == list(range(1, 9)):
            raise KeyboardInterrupt

    monkeypatch.setattr(Checkpoint, "save_sometimes", save_and_die)
    with pytest.raises(KeyboardInterrupt):
        gaussians_stage.main(**inputs, **killed, options=options)
    assert not any(path.exists() for path in killed.values())
    monkeypatch.setattr(costs, "_before", {})
    for given, step in ((options.model_copy(update={"seed": 1}), 0), (options, 8)):  # that of other options is not used
        trainer = begin(*inputs.values(), given, tmp_path).trainer
        Checkpoint(killed["model"], list(inputs.values()), given).resume(trainer)
        assert trainer.step == step
    gaussians_stage.main(**inputs, **killed, options=options)
    assert steps == list(range(1, 21))  # nothing was done twice
    assert costs.spent()["taken_over_s"] > 0
    assert killed["ply"].read_bytes() == straight["ply"].read_bytes()
    tensors, expected = read_model(killed["model"]), read_model(straight["model"])
    assert all(np.array_equal(tensors[name], expected[name]) for name in expected)


def test_a_checkpoint_that_a_power_cut_has_damaged_is_not_used(tmp_path: Path) -> None:
    inputs, paths, options = write_inputs(tmp_path), outputs(tmp_path / "out"), GaussiansOptions(steps=2, stride_px=4)
    left = Checkpoint(paths["model"], list(inputs.values()), options).path
    left.parent.mkdir()
    left.write_bytes(b"cut off")
    gaussians_stage.main(**inputs, **paths, options=options)
    assert paths["model"].exists()
    assert not left.exists()


def test_frames_are_rendered_with_the_shutter_and_new_views_without(tmp_path: Path) -> None:
    inputs, results = write_inputs(tmp_path), outputs(tmp_path / "out")
    write_json(inputs["scene"], read_json(inputs["scene"]) | {"motion_blur": {"needed": True, "shutter": 0.9}})
    gaussians_stage.main(**inputs, **results, options=GaussiansOptions(steps=2, stride_px=4))
    assert read_metadata(results["model"])["shutter"] == 0.9
    renders, video = tmp_path / "renders", tmp_path / "video.gif"
    chosen = RenderOptions(novel_views=2, orbit_share=0)
    render_stage.main(inputs["sequence"], inputs["poses"], results["model"], renders, video, chosen)
    scene, Ks = read_scene(results["model"]), np.tile(truth.K, (truth.T, 1, 1))
    size = (truth.WIDTH, truth.HEIGHT)
    with torch.no_grad():
        smeared = [expose(scene, moments(Shutter(0.9, truth.cameras(), Ks), k, 2), *size)[0] for k in (0, 4)]
        sharp = expose(scene, instant(0.0, truth.cameras()[0], truth.K), *size)[0]
    shown = [
        read_rgb(renders / name) for name in ("train/frame_0001.png", "test/frame_0005.png", "novel/frame_0001.png")
    ]
    for image, expected in zip(shown, [*smeared, sharp], strict=True):
        assert np.abs(image.astype(int) - to_uint8(expected.numpy()).astype(int)).max() <= 1
    assert np.abs(shown[0].astype(int) - shown[2]).max() > 10


def test_failed_poses_give_a_static_scene_that_says_so(tmp_path: Path) -> None:
    """One sequence without poses must not keep the others out of the report; its movers stay where they are."""
    inputs, results = write_inputs(tmp_path), outputs(tmp_path / "out")
    assert read_json(inputs["scene"])["dynamic"]["needed"]
    write_status(inputs["poses"], np.full(truth.T, "failed", object), np.tile(np.eye(4), (truth.T, 1, 1)))
    control_inputs = {name: inputs[name] for name in ("sequence", "masks", "poses", "depth", "scene")}
    written = {name: inputs[name] for name in ("points", "deformation")} | {"figure": tmp_path / "control.png"}
    control_stage.main(flow=tmp_path / "never_read", **control_inputs, **written, options=ControlOptions())
    gaussians_stage.main(**inputs, **results, options=GaussiansOptions(steps=2, stride_px=4))
    assert read_metadata(inputs["deformation"])["status"] == "the poses failed"
    for name in ("model", "half"):
        metadata = read_metadata(results[name])
        assert (metadata["status"], metadata["n_dynamic"]) == ("poses failed", 0)
    renders, video = tmp_path / "out" / "renders", tmp_path / "out" / "video.gif"
    chosen = RenderOptions(novel_views=2)
    render_stage.main(inputs["sequence"], inputs["poses"], results["model"], renders, video, chosen)
    assert len(list(renders.glob("t*/frame_*.png"))) == truth.T


def write_status(poses: Path, status: np.ndarray, cam_from_world: np.ndarray) -> None:
    """Write the cameras of the scene with this status [T] and these poses [T, 4, 4]."""
    write_cameras(poses, make_cameras(cam_from_world, truth.K, np.arange(1, truth.T + 1), status=status))


def arrays_of(seen: TrainingFrames) -> dict[str, np.ndarray]:
    """All that there is of every frame, by name, [F, ...]."""
    names = ("images", "masks", "depths", "guessed", "cam_from_world", "Ks", "times")
    every = {name: getattr(seen, name) for name in names}
    return {name: np.array([maps[f] for f in range(len(maps))]) for name, maps in every.items()}


def test_frames_with_a_bridged_pose_are_not_trained_on(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    inputs = write_inputs(tmp_path)
    paths = {name: inputs[name] for name in ("sequence", "masks", "poses", "depth")}
    everything = read_observations(**paths, split=SplitOptions())
    status = np.full(truth.T, "estimated", object)
    status[[2, 4]] = "unobserved"  # frame 3, and frame 5, which is held out anyway
    write_status(inputs["poses"], status, truth.cameras())
    with caplog.at_level("WARNING", logger="motionsplat"):
        seen = read_observations(**paths, split=SplitOptions())
    assert "frames [3] have no matches of their own and are left out" in caplog.text
    assert seen.smeared is everything.smeared is seen.scene is everything.scene is None
    before, after = arrays_of(everything), arrays_of(seen)
    assert all(np.array_equal(np.delete(before[name], 2, axis=0), after[name]) for name in after)
    status[1:] = "unobserved"
    write_status(inputs["poses"], status, truth.cameras())
    assert len(read_observations(**paths, split=SplitOptions()).images) == truth.T - 1


def test_masks_that_the_poses_distrust_are_left_out(tmp_path: Path) -> None:
    inputs = write_inputs(tmp_path)
    paths = {name: inputs[name] for name in ("sequence", "masks", "poses", "depth")}
    masks = read_observations(**paths, split=SplitOptions()).masks
    trusted = np.arange(truth.T) != 2
    write_cameras(paths["poses"], replace(read_cameras(paths["poses"]), masks_trusted=trusted))
    seen = read_observations(**paths, split=SplitOptions())
    assert masks[2].any()
    assert not seen.masks[2].any()
    assert all(np.array_equal(masks[f], seen.masks[f]) for f in range(len(masks)) if f != 2)


def test_held_out_frames_are_never_opened(tmp_path: Path) -> None:
    inputs = write_inputs(tmp_path)
    paths = {name: inputs[name] for name in ("sequence", "masks", "poses", "depth")}
    before = read_observations(**paths, split=SplitOptions())
    (tmp_path / "frames" / "frame_0005.png").unlink()
    (tmp_path / "masks" / "frame_0005.png").unlink()
    after = read_observations(**paths, split=SplitOptions())
    assert len(after.images) == truth.T - 1
    same = zip(arrays_of(before).values(), arrays_of(after).values(), strict=True)
    assert all(np.array_equal(a, b) for a, b in same)


@pytest.mark.parametrize("column", ["qw", "tz", "fx", "frame", "covariance", "status"])
def test_cameras_that_lack_a_column_are_refused(tmp_path: Path, column: str) -> None:
    write_status(tmp_path / "poses.parquet", np.full(truth.T, "estimated", object), truth.cameras())
    table = read_table(tmp_path / "poses.parquet")
    del table[column]
    write_table(tmp_path / "foreign.parquet", table)
    with pytest.raises(InputError, match=rf"foreign.parquet: expected cameras .* found no '{column}'"):
        read_cameras(tmp_path / "foreign.parquet")


@pytest.mark.parametrize("settings", [{}, {"width": 96, "height": 64}])
def test_a_model_of_something_else_is_no_scene(tmp_path: Path, settings: dict[str, int]) -> None:
    write_status(tmp_path / "poses.parquet", np.full(truth.T, "estimated", object), truth.cameras())
    write_model(tmp_path / "other.safetensors", {"means": np.zeros((3, 3), np.float32)}, settings)
    with pytest.raises(InputError, match=r"other.safetensors: expected a model of the Gaussians, found no '"):
        view.main(tmp_path / "other.safetensors", tmp_path / "poses.parquet", tmp_path / "views", ViewOptions())
    assert not (tmp_path / "views").exists()


def test_masks_of_another_size_are_refused(tmp_path: Path) -> None:
    inputs = write_inputs(tmp_path)
    Image.new("L", (10, 10)).save(tmp_path / "masks" / "frame_0002.png")
    paths = {name: inputs[name] for name in ("sequence", "masks", "poses", "depth")}
    with pytest.raises(InputError, match=r"expected 96 x 64, found 10 x 10"):
        read_observations(**paths, split=SplitOptions())
