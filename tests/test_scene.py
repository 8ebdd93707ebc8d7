"""Exact inputs of scene and control: the wall with a moving square, whole or with its held-out frame poisoned."""

import json
from pathlib import Path

import finished_run as clip
import numpy as np
import pytest
from square_inputs import HELD_OUT, observe, write_inputs
from synthetic import flow_arrays, make_scene

from stages.scene import __main__ as scene_stage
from stages.scene import exposure, geometry, photometry, rules
from stages.scene.observed import Observed, depth_on_grid
from stages.scene.options import SceneOptions
from stages.shared.artifacts import read_dense, write_dense
from stages.shared.cameras import make_cameras, pixel_grid, unproject, write_cameras
from stages.shared.cli import run
from stages.shared.errors import InputError
from stages.shared.images import write_image
from stages.shared.options import validate
from stages.shared.sequences import read_sequence


def smooth_pictures(gain: np.ndarray, shine: float = 0.0) -> np.ndarray:
    """Frames [T, H, W, 3] of a softly shaded wall, with a gain per frame, and a shine that depends on the view only."""
    images = []
    for k in range(clip.T):
        points, _ = clip.wall(k)
        shade = 0.4 + 0.1 * np.sin(2 * points[..., 0]) * np.cos(3 * points[..., 1])
        rays = points - clip.CENTRES[k]
        direction = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        images.append(gain[k] * (shade + shine * direction[..., 0]))
    return np.repeat(np.stack(images)[..., None], 3, axis=-1)


@pytest.mark.parametrize("scale", [0.5, 512 / 854])
def test_depth_lies_where_the_solver_put_it(scale: float) -> None:
    """Every second pixel of the flow grid, also where that is no whole number of pixels of the frame."""
    stride_px = 2 / scale
    grid_u = stride_px * np.arange(40) + (stride_px - 1) / 2  # full-frame pixels
    coarse = np.repeat(np.exp(-0.01 * grid_u)[None], 30, axis=0)[None]
    full_u = (np.arange(80) + 0.5) / scale - 0.5
    inner = slice(4, 70)
    found = depth_on_grid(coarse, stride_px, scale, 60, 80)[0]
    np.testing.assert_allclose(found[:, inner], np.exp(0.01 * full_u[None, inner]).repeat(60, 0), rtol=1e-3)


def test_a_moving_square_is_dynamic() -> None:
    evidence = geometry.dynamic_evidence(observe())
    assert evidence["residual_inside_px"] > 2.0  # two frames of 0.08 units at depth 4 with 90 px focal length
    assert evidence["residual_outside_px"] < 0.05
    assert rules.decide_dynamic(evidence, "auto")["needed"]


def test_masks_on_the_wall_are_a_false_alarm() -> None:
    masks = np.zeros((clip.T, clip.H, clip.W), bool)
    masks[:, 50:60, 5:30] = True  # the square never gets here
    decision = rules.decide_dynamic(geometry.dynamic_evidence(observe(dynamic=masks)), "auto")
    assert not decision["needed"]
    assert "static scene explains" in decision["why"]


def test_empty_masks_say_so() -> None:
    masks = np.zeros((clip.T, clip.H, clip.W), bool)
    decision = rules.decide_dynamic(geometry.dynamic_evidence(observe(dynamic=masks)), "auto")
    assert not decision["needed"]
    assert "cover 0.00%" in decision["why"]


def test_parallax_tells_travel_from_turning() -> None:
    seen = observe()
    travelled = geometry.parallax_evidence(seen)
    assert travelled["parallax_px"] == pytest.approx(90.0 / 4, rel=0.25)  # one unit of travel at depth 4
    turning = seen.cam_from_world.copy()
    turning[:, :3, 3] = 0
    still = geometry.parallax_evidence(Observed(**(vars(seen) | {"cam_from_world": turning})))
    assert still["parallax_px"] < 1e-6
    marked = {"frames_marked_share": 0.0}
    assert rules.decide_rotation_only(still | marked, "auto")["needed"]
    assert not rules.decide_rotation_only(travelled | marked, "auto")["needed"]
    assert rules.decide_rotation_only(travelled | {"frames_marked_share": 1.0}, "auto")["needed"]


@pytest.mark.parametrize("range_percent", [0.0, 12.0])
def test_exposure_range_is_measured(range_percent: float) -> None:
    gain = np.exp(np.linspace(0, np.log1p(range_percent / 100), clip.T))
    evidence = exposure.exposure_evidence(exposure.measure_gains(observe(smooth_pictures(gain))))
    assert evidence["gain_range_percent"] == pytest.approx(range_percent, abs=0.5)
    assert rules.decide_exposure(evidence, "auto")["needed"] == (range_percent > 3)


def test_brightness_of_near_pixels_alone_is_no_exposure_change() -> None:
    images = smooth_pictures(np.ones(clip.T))
    for k in range(clip.T):
        depth = clip.wall(k)[1]
        images[k, depth < np.median(depth)] *= 1 + 0.02 * k  # as when fog thins out in front
    evidence = exposure.exposure_evidence(exposure.measure_gains(observe(images)))
    assert evidence["near_range_percent"] > 5
    assert not rules.decide_exposure(evidence, "auto")["needed"]


def in_fog(extinction: float, airlight: float, drift_percent: float, noise: float = 0.0) -> Observed:
    """A room that the camera goes into, through fog of linear radiance `airlight`, its brightness drifting."""
    room = make_scene(size=(96, 160))
    source, target, flow, visible = flow_arrays(room, (1,))
    gain = np.exp(np.linspace(0, np.log1p(drift_percent / 100), room.T))
    rng, rgb = np.random.default_rng(0), []
    for depth, pose, g in zip(room.depth, room.cam_from_world, gain, strict=True):
        points = unproject(pixel_grid(96, 160), depth, pose, room.K)
        x, y, z = np.moveaxis(points, -1, 0)
        surface = 0.3 + 0.25 * np.sin(3 * x + z) * np.cos(4 * y + 2 * z)
        clear = np.exp(-extinction * np.linalg.norm(points - np.linalg.inv(pose)[:3, 3], axis=-1))
        shown = g * (clear * surface + (1 - clear) * airlight) ** (1 / 2.2)
        rgb.append(np.clip(np.rint(255 * (shown + noise * rng.standard_normal(shown.shape))), 0, 255) / 255)
    return Observed(
        rgb=np.repeat(np.stack(rgb)[..., None], 3, axis=-1).astype(np.float32),
        dynamic=np.zeros(room.depth.shape, bool),
        instances=np.zeros(room.depth.shape, np.uint16),
        depth=room.depth,
        cam_from_world=room.cam_from_world,
        Ks=np.broadcast_to(room.K, (room.T, 3, 3)),
        edges=np.stack([source, target], axis=1),
        flow=flow,
        confidence=visible,
        offsets=target - source,
    )


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("drift_percent", [0.0, 15.0])
@pytest.mark.parametrize(("extinction", "airlight"), [(0.0, 0.6), (0.15, 0.6), (0.3, 0.9), (0.3, 0.05), (0.5, 0.05)])
def test_fog_is_told_from_exposure(extinction: float, airlight: float, drift_percent: float, noise: float) -> None:
    """On the way into fog everything darkens or brightens, near and far alike."""
    seen = in_fog(extinction, airlight, drift_percent, noise)
    evidence = exposure.exposure_evidence(exposure.measure_gains(seen))
    decision = rules.decide_exposure(evidence, "auto")
    assert decision["needed"] == (drift_percent > 0)
    assert evidence["gain_range_percent"] == pytest.approx(drift_percent, abs=4 * evidence["standard_error_percent"])
    assert decision["evidence"]["threshold_percent"] >= rules.MIN_GAIN_PERCENT


def test_view_dependence_is_predicted_on_left_out_frames() -> None:
    gains = np.zeros(clip.T)
    dull = photometry.view_evidence(observe(smooth_pictures(np.ones(clip.T))), gains)
    shiny = photometry.view_evidence(observe(smooth_pictures(np.ones(clip.T), shine=0.5)), gains)
    noise = np.random.default_rng(0).normal(0, 0.03, clip.T)[:, None, None, None]
    flicker = photometry.view_evidence(observe(smooth_pictures(np.ones(clip.T)) + noise), gains)
    assert rules.decide_view_dependent(dull, "auto")["sh_degree"] == 0
    assert rules.decide_view_dependent(shiny, "auto")["sh_degree"] >= 1
    assert shiny["gain_degree1"] > 0.8
    assert rules.decide_view_dependent(flicker, "auto")["sh_degree"] == 0


def test_the_user_overrules_and_the_evidence_stays() -> None:
    evidence = geometry.dynamic_evidence(observe())
    decision = rules.decide_dynamic(evidence, "no")
    assert not decision["needed"]
    assert decision["source"] == "user"
    assert decision["evidence"] == evidence
    assert (
        rules.decide_view_dependent(
            {"colour_change": 0.0, "gain_degree1": 0.0, "gain_degree2": 0.0, "view_angle_deg": 1.0}, "yes"
        )["sh_degree"]
        == 1
    )


def test_yaml_booleans_are_choices() -> None:
    options = validate(SceneOptions, {"dynamic": True, "exposure": False}, "config.yaml: scene")
    assert (options.dynamic, options.exposure) == ("yes", "no")
    with pytest.raises(InputError, match="dynamic"):
        validate(SceneOptions, {"dynamic": "maybe"}, "config.yaml: scene")


def decide_in(folder: Path, paths: dict[str, Path], *more: str) -> dict[str, dict]:
    flags = [word for name, path in paths.items() for word in (f"--{name}", str(path))]
    with pytest.raises(SystemExit) as end:
        run(
            scene_stage.main, [*flags, "--output", str(folder / "scene.json"), "--figure", str(folder / "s.png"), *more]
        )
    assert end.value.code == 0
    return json.loads((folder / "scene.json").read_text())


def test_decisions_of_the_square_and_of_the_bare_wall(tmp_path: Path) -> None:
    square = decide_in(tmp_path / "square", write_inputs(tmp_path / "square"))
    wall = decide_in(tmp_path / "wall", write_inputs(tmp_path / "wall", motion=False))
    assert square["dynamic"]["needed"]
    assert not wall["dynamic"]["needed"]
    assert not square["rotation_only"]["needed"]
    overruled = decide_in(tmp_path / "wall", write_inputs(tmp_path / "wall", motion=False), "--dynamic", "yes")
    assert overruled["dynamic"] | {"why": ""} == wall["dynamic"] | {"needed": True, "source": "user", "why": ""}


@pytest.mark.parametrize(("wrong", "left_out"), [([1, 5], 2), (range(clip.T), 0)])
def test_a_mask_that_the_poses_distrust_does_not_hide_what_moves(
    tmp_path: Path, wrong: list[int], left_out: int
) -> None:
    """A mask over all of a frame holds the static wall, so that the static scene explains what is masked."""
    paths = write_inputs(tmp_path)
    trusted = ~np.isin(np.arange(clip.T), list(wrong))
    for k in wrong if left_out else []:
        write_image(paths["masks"] / f"frame_{k + 1:04d}.png", np.ones((clip.H, clip.W), bool))
    numbers = np.arange(1, clip.T + 1)
    write_cameras(paths["poses"], make_cameras(clip.CAM_FROM_WORLD, clip.K, numbers, masks_trusted=trusted))
    dynamic = decide_in(tmp_path, paths)["dynamic"]
    assert dynamic["needed"]
    assert (dynamic["masks_distrusted"], dynamic["masks_left_out"]) == (len(wrong), left_out)
    assert "which the pose stage distrusts" in dynamic["why"]


def test_a_depth_grid_of_broken_pixels_is_read_as_it_is(tmp_path: Path) -> None:
    """Frames 854 pixels wide, matched at 512, have a depth every 6.67 pixels: 6 would shift the far edge by 85."""
    paths = write_inputs(tmp_path)
    inverse_depth = read_dense(paths["depth"])["inverse_depth"] * np.linspace(1, 2, clip.W // 4, dtype=np.float32)
    write_dense(paths["depth"], {"inverse_depth": inverse_depth}, {"stride_px": 4.5})
    content = read_sequence(paths.pop("sequence"))
    seen = scene_stage._observe(content, **paths, options=SceneOptions())
    frames = [k for k in range(clip.T) if k != HELD_OUT]
    np.testing.assert_allclose(seen.depth, depth_on_grid(inverse_depth[frames], 4.5, 1.0, clip.H, clip.W), rtol=1e-6)


def test_held_out_frames_decide_nothing(tmp_path: Path) -> None:
    clean = decide_in(tmp_path / "a", write_inputs(tmp_path / "a"))
    poisoned = decide_in(tmp_path / "b", write_inputs(tmp_path / "b", poison=True))
    assert poisoned == clean
