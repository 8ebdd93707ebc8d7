"""Exact inputs of scene and control: the wall with a moving square, whole or with its held-out frame poisoned."""

import json
from dataclasses import replace
from pathlib import Path

import finished_run as clip
import numpy as np
import pytest
from square_inputs import HELD_OUT, observe, write_inputs
from synthetic import flow_arrays, make_scene

from stages.scene import __main__ as scene_stage
from stages.scene import bending, geometry, rules
from stages.scene.observed import Observed, depth_on_grid
from stages.scene.options import SceneOptions
from stages.scene.travel import travel_evidence
from stages.shared import lie
from stages.shared.artifacts import read_dense, write_dense
from stages.shared.cameras import make_cameras, write_cameras
from stages.shared.cli import run
from stages.shared.errors import InputError
from stages.shared.images import write_image
from stages.shared.options import validate
from stages.shared.rolling import rolling_shutter
from stages.shared.sequences import read_sequence


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
    decision = rules.decide_dynamic(evidence, "auto")
    assert evidence.inside_px > 2.0  # two frames of 0.08 units at depth 4 with 90 px focal length
    assert evidence.outside_px < 0.05
    assert decision["needed"]
    assert decision["statistic"] == pytest.approx(evidence.inside_px / 2**0.5, rel=0.1)  # both components of the flow


def test_a_mover_too_fast_for_long_edges_is_seen_over_short_ones() -> None:
    """Its flow over the longest edges is nowhere sure, which says nothing against its motion."""
    seen = observe()
    blind = (np.abs(seen.offsets) == 2)[:, None, None] & seen.dynamic[seen.edges[:, 0]]
    evidence = geometry.dynamic_evidence(replace(seen, confidence=np.where(blind, 0, seen.confidence)))
    assert rules.decide_dynamic(evidence, "auto")["needed"]
    assert evidence.inside_px == pytest.approx(0.08 * 90 / 4, rel=0.1)  # one frame


def test_a_mover_that_fills_the_view_and_bends_is_dynamic() -> None:
    """No plane moves as all of it: as one region it would pass for static."""
    seen = observe()
    y, x = np.mgrid[: clip.H, : clip.W]
    ripple = np.stack([np.sin(x / 14) * np.cos(y / 16), np.cos(x / 15 + y / 17)], axis=-1)
    rippling = seen.flow + (0.3 * seen.offsets[:, None, None, None] * ripple).astype(np.float32)
    everywhere = np.ones_like(seen.dynamic)
    seen = replace(seen, dynamic=everywhere, instances=everywhere.astype(np.uint16), flow=rippling)
    rms = np.sqrt((0.6 * ripple) ** 2).mean()
    found = rules.decide_dynamic(geometry.dynamic_evidence(seen), "auto")
    assert found["needed"]
    assert found["statistic"] > 0.7 * rms
    still = replace(seen, flow=observe().flow)
    assert not rules.decide_dynamic(geometry.dynamic_evidence(still), "auto")["needed"]


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


def test_a_rolling_shutter_moves_nothing() -> None:
    """Flow with what the shutter adds, in bands, tells of parts, bending and travel what flow without it tells."""
    seen = observe()
    bands = np.sin(np.arange(clip.H) / 5)[:, None, None] * np.broadcast_to([0.8, -0.5], seen.flow.shape)
    bands *= np.sign(seen.offsets)[:, None, None, None]  # pixels return along the opposite edge
    rolled = replace(seen, flow=seen.flow + bands.astype(np.float32))
    told = replace(rolled, unrolled=seen.flow)
    assert geometry.dynamic_evidence(rolled).outside_px > 0.3
    parts = geometry.dynamic_evidence(told)
    assert parts.outside_px < 0.05
    assert parts.bought.before - parts.bought.saved < 1e-4
    assert travel_evidence(told).size == pytest.approx(travel_evidence(seen).size, rel=0.01)
    of_told, of_rolled = (bending.bending_evidence(of)[1].bought.before for of in (told, rolled))
    assert of_told < 0.1 * of_rolled


def test_the_shutter_of_the_poses_is_that_of_the_edges_between_training_frames(tmp_path: Path) -> None:
    paths, numbers = write_inputs(tmp_path), np.arange(1, clip.T + 1)
    cameras = make_cameras(clip.CAM_FROM_WORLD, clip.K, numbers)
    write_cameras(paths["poses"], cameras, {"rolling_shutter": {"decision": "rolling", "readout": 1.0}})
    content, pairs = read_sequence(paths["sequence"]), read_dense(paths["flow"])
    seen = scene_stage._observe(content, *(paths[name] for name in ("flow", "masks", "poses", "depth")), SceneOptions())
    rolling, is_training = rolling_shutter(content, cameras, 1.0, paths["depth"], 1.0), numbers - 1 != HELD_OUT
    assert seen.unrolled is not None
    rows = np.flatnonzero(is_training[pairs["source"]] & is_training[pairs["target"]])
    for e, row in enumerate(rows):
        i, j, flow = (pairs[name][row] for name in ("source", "target", "flow"))
        flow = flow.astype(np.float32)
        np.testing.assert_allclose(seen.at_once(e), flow - rolling.shifts(i, j, flow), atol=1e-5)
    assert max(np.abs(seen.at_once(e) - seen.flow[e]).max() for e in range(len(rows))) > 0.1


def panned(motion: str, noise_px: float, spurious: float) -> Observed:
    """A room seen on a path of `synthetic.camera_path`, with noisy flow, and travel that the poses add to the truth."""
    scene = make_scene(motion=motion)
    source, target, flow, visible = flow_arrays(scene, (1, 2, 4))
    poses = scene.cam_from_world.copy()
    poses[:, :3, 3] += spurious * np.linspace(0, 1, scene.T)[:, None] * [1.0, 0.2, 0.4]
    noise = np.random.default_rng(0).standard_normal(flow.shape).astype(np.float32)
    still = np.zeros(scene.depth.shape, bool)
    return Observed(
        rgb=np.zeros((*still.shape, 3), np.float32),
        dynamic=still,
        instances=still.astype(np.uint16),
        depth=scene.depth,
        cam_from_world=poses,
        Ks=np.broadcast_to(scene.K, (scene.T, 3, 3)),
        edges=np.stack([source, target], axis=1),
        flow=flow + noise_px * noise,
        confidence=visible,
        offsets=target - source,
    )


@pytest.mark.parametrize("spurious", [0.0, 0.02, 0.3])
def test_a_pan_is_told_from_travel(spurious: float) -> None:
    """Also where the poses travel: their depth fits each flow, but not that to other frames."""
    turning = rules.decide_rotation_only(travel_evidence(panned("rotate", 0.1, spurious)), 0.0, "auto")
    assert turning["needed"]
    assert turning["interval"][1] < turning["threshold"]


def test_a_pan_is_told_from_travel_where_pixels_are_not_square() -> None:
    """Every fourth row of the frames, so that fy is a quarter of fx, and poses with an error about the view."""
    seen, rows = panned("rotate", 0.1, 0.3), np.diag([1.0, 0.25, 1.0])
    rolled = lie.exp_se3(np.linspace(-0.1, 0.1, len(seen.rgb))[:, None] * np.eye(6)[5]) @ seen.cam_from_world
    flow = seen.flow[:, ::4] * np.array([1, 0.25], np.float32)
    fewer = {name: getattr(seen, name)[:, ::4] for name in ("rgb", "dynamic", "instances", "depth", "confidence")}
    tall = replace(seen, flow=flow, Ks=rows @ seen.Ks, cam_from_world=rolled, **fewer)
    assert rules.decide_rotation_only(travel_evidence(tall), 0.0, "auto")["needed"]


@pytest.mark.parametrize("motion", ["curve", "drift"])
def test_travel_is_told_from_a_pan(motion: str) -> None:
    """Also travel beside a fast pan that moves what is seen by less than the noise of the flow."""
    travel = travel_evidence(panned(motion, 0.1, 0.0))
    assert not rules.decide_rotation_only(travel, 0.0, "auto")["needed"]
    assert rules.decide_rotation_only(travel, 1.0, "auto")["needed"]  # the pose stage says so


def test_the_user_overrules_and_the_evidence_stays() -> None:
    evidence = geometry.dynamic_evidence(observe())
    decision, own = rules.decide_dynamic(evidence, "no"), rules.decide_dynamic(evidence, "auto")
    assert not decision["needed"]
    assert decision["source"] == "user"
    assert all(decision[name] == own[name] for name in ("statistic", "interval", "threshold", "evidence"))


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
    content = json.loads((folder / "scene.json").read_text())
    assert all(content[name].pop("seconds") >= 0 for name in SceneOptions.model_fields if name in content)
    return content


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
    found = np.array([seen.depth[f] for f in range(len(frames))])
    np.testing.assert_allclose(found, depth_on_grid(inverse_depth[frames], 4.5, 1.0, clip.H, clip.W), rtol=1e-6)


def test_edges_between_places_seen_again_decide_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = write_inputs(tmp_path)
    content = read_sequence(paths.pop("sequence"))
    before = scene_stage._observe(content, **paths, options=SceneOptions())
    monkeypatch.setattr(scene_stage, "REACH", 1)
    seen = scene_stage._observe(content, **paths, options=SceneOptions())
    near = np.flatnonzero(np.abs(before.offsets) == 1)
    assert 0 < len(near) < len(before.offsets)
    np.testing.assert_array_equal(seen.edges, before.edges[near])
    np.testing.assert_array_equal(seen.flow[3], before.flow[int(near[3])])


def test_held_out_frames_decide_nothing(tmp_path: Path) -> None:
    clean = decide_in(tmp_path / "a", write_inputs(tmp_path / "a"))
    poisoned = decide_in(tmp_path / "b", write_inputs(tmp_path / "b", poison=True))
    assert poisoned == clean
