"""Rounds that begin as the round before began: told by the flow of the static scene, and carried over as files."""

import re
from pathlib import Path

import numpy as np
import pytest
from conftest import run_snakemake
from synthetic import Scene, make_scene
from test_motion_script import write_inputs

from stages.motion.__main__ import main as motion_main
from stages.motion.options import MotionOptions
from stages.segment.__main__ import main as segment_main
from stages.segment.options import SegmentOptions
from stages.shared import lie
from stages.shared.artifacts import read_dense, write_dense, write_json
from stages.shared.cameras import make_cameras, write_cameras
from stages.shared.errors import InputError
from stages.shared.images import read_mask
from stages.shared.settled import is_settled

STRIDE = 8


def write_round(
    folder: Path,
    scene: Scene,
    turn_px: float = 0.0,
    focal: float = 1.0,
    nearer: float = 0.0,
    frame: int | None = None,
    drift_px: float = 0.0,
    readout: float = 0.0,
    status: str = "estimated",
) -> tuple[Path, Path]:
    """Poses and depth of a round. Every other camera, or that of `frame` alone, is turned by so many px, each by
    `drift_px` more than the one before; the lens is `focal` times as long; a share of the columns is twice as near."""
    folder.mkdir(parents=True, exist_ok=True)
    K, turns = scene.K.copy(), np.zeros((scene.T, 6))
    K[:2, :2] *= focal
    turns[slice(0, None, 2) if frame is None else frame, 4] = turn_px / K[0, 0]
    turns[:, 4] += np.arange(scene.T) * drift_px / K[0, 0]
    numbers, statuses = np.arange(1, scene.T + 1), np.full(scene.T, status, object)
    cameras = make_cameras(lie.exp_se3(turns) @ scene.cam_from_world, K, numbers, status=statuses)
    rolling = {"decision": "rolling" if readout else "global", "readout": readout}
    write_cameras(folder / "poses.parquet", cameras, {"rolling_shutter": rolling})
    half = STRIDE // 2
    depth = np.stack([frame[half::STRIDE, half::STRIDE] for frame in scene.depth]).astype(np.float32)
    depth[:, :, : round(nearer * depth.shape[2])] /= 2
    write_dense(folder / "depth.arrow", {"frame": numbers, "inverse_depth": 1 / depth}, {"stride_px": STRIDE})
    return folder / "poses.parquet", folder / "depth.arrow"


@pytest.mark.parametrize(
    ("changed", "settled"),
    [
        ({}, True),
        ({"turn_px": 0.08}, True),
        ({"turn_px": 0.15}, False),
        ({"turn_px": 0.5, "frame": 4}, False),
        ({"drift_px": 0.05}, False),
        ({"focal": 1.3}, False),
        ({"nearer": 0.4}, True),
        ({"nearer": 0.7}, False),
        ({"readout": 0.001}, True),
        ({"readout": 0.5}, False),
        ({"status": "unobserved"}, False),
    ],
)
def test_two_rounds_are_alike_if_most_of_the_static_scene_flows_alike(
    changed: dict, settled: bool, tmp_path: Path
) -> None:
    """What is nearer in fewer than half of the pixels may be a mover, whose depth says nothing of the cameras."""
    scene = make_scene(T=10)
    then, now = write_round(tmp_path / "then", scene), write_round(tmp_path / "now", scene, **changed)
    assert is_settled(now, then, scale=1.0) == settled
    assert is_settled(then, now, scale=1.0) == settled


def test_flow_is_compared_in_pixels_of_its_grid(tmp_path: Path) -> None:
    scene = make_scene()
    then, now = write_round(tmp_path / "then", scene), write_round(tmp_path / "now", scene, turn_px=0.15)
    assert is_settled(now, then, scale=0.5)


def test_prior_and_masks_are_carried_over_while_cameras_stay(tmp_path: Path) -> None:
    """Marked results of the round before appear again, with the same cameras; with others they are made anew."""
    scene = make_scene(disc_radius=0.5)
    sequence, flow = write_inputs(tmp_path, scene)
    then, now = write_round(tmp_path / "then", scene), write_round(tmp_path / "now", scene)
    motion_main(sequence, flow, prior := tmp_path / "then.arrow", tmp_path / "m.png", MotionOptions(), *then)
    segment_main(sequence, masks := tmp_path / "masks", tmp_path / "s.png", SegmentOptions(), flow, prior, *then)
    for figure in ("m.png", "s.png"):
        (tmp_path / figure).write_bytes(b"marked")
    made = tmp_path / "prior.arrow", tmp_path / "prior.png"
    said = motion_main(sequence, flow, *made, MotionOptions(), *now, prior, tmp_path / "m.png", *then)
    assert "unchanged" in said
    assert made[0].read_bytes() == prior.read_bytes()
    assert made[1].read_bytes() == b"marked"
    drawn = tmp_path / "again", tmp_path / "again.png"
    kept = masks, tmp_path / "s.png", *then
    assert "unchanged" in segment_main(sequence, *drawn, SegmentOptions(), flow, prior, *now, *kept)
    assert drawn[1].read_bytes() == b"marked"
    names = sorted(file.relative_to(masks) for file in masks.rglob("*.*"))
    assert len(names) == 2 * scene.T + 1
    assert names == sorted(file.relative_to(drawn[0]) for file in drawn[0].rglob("*.*"))
    assert all((drawn[0] / name).read_bytes() == (masks / name).read_bytes() for name in names)

    turned = write_round(tmp_path / "turned", scene, turn_px=3.0)
    said = motion_main(sequence, flow, *made, MotionOptions(), *turned, prior, tmp_path / "m.png", *then)
    assert "seem to move" in said
    assert not np.array_equal(read_dense(made[0])["probability"], read_dense(prior)["probability"])
    assert "dynamic" in segment_main(sequence, *drawn, SegmentOptions(), flow, made[0], *turned, *kept)
    assert any((read_mask(drawn[0] / n.name) != read_mask(masks / n.name)).any() for n in masks.glob("frame_*.png"))


def test_prior_and_masks_are_carried_over_by_pixels_of_the_flow_grid(tmp_path: Path) -> None:
    """A turn of 3 px is one of .03 px on a grid of a hundredth of the width."""
    scene = make_scene(disc_radius=0.5)
    sequence, flow = write_inputs(tmp_path, scene)
    write_dense(flow, dict(read_dense(flow)), {"width": 96, "height": 64, "scale": 0.01})
    then, now = write_round(tmp_path / "then", scene), write_round(tmp_path / "now", scene, turn_px=3.0)
    figure, prior, masks = tmp_path / "then.png", tmp_path / "then.arrow", tmp_path / "masks"
    figure.touch()
    write_dense(prior, {"frame": np.arange(scene.T)}, {"moving_share": 0.25})
    masks.mkdir()
    write_json(masks / "masks.json", {"dynamic_share": {"1": 0.25}, "instances": {}, "guarded": [1]})
    made = tmp_path / "prior.arrow", tmp_path / "prior.png"
    said = motion_main(sequence, flow, *made, MotionOptions(), *now, prior, figure, *then)
    assert said == "cameras unchanged: 25.0% of the pixels seem to move"
    drawn = tmp_path / "again", tmp_path / "again.png"
    said = segment_main(sequence, *drawn, SegmentOptions(), flow, prior, *now, masks, figure, *then)
    assert said == "cameras unchanged: 25.0% of the pixels dynamic"


def test_rounds_read_two_rounds_back_from_the_fourth_on(repo_copy: Path) -> None:
    """Not before: the first poses know nothing of movers."""
    plan = run_snakemake(repo_copy, "-n", "masks", "--config", "rounds=4")
    told = (plan.stdout + plan.stderr).replace("results/simulated/demo/", "")
    for rule, result in (("motion", "motion/prior.arrow"), ("segment", "masks")):
        jobs = re.findall(rf"rule {rule}:\n\s+input: (.+)\n\s+output: (.+)", told)
        reads = {made.split(", ")[0]: set(read.split(", ")) for read, made in jobs}
        before = {f"round3/{name}" for name in (result, f"figures/{rule}.png", "ba/poses.parquet", "ba/depth.arrow")}
        assert reads[result] >= before | {"round2/ba/poses.parquet", "round2/ba/depth.arrow"}
        assert not any(name.startswith("round1/") for name in reads[f"round3/{result}"])


def test_results_without_the_cameras_that_they_began_with_are_refused(tmp_path: Path) -> None:
    scene = make_scene()
    (sequence, flow), now = write_inputs(tmp_path, scene), write_round(tmp_path / "now", scene)
    made = tmp_path / "prior.arrow", tmp_path / "prior.png"
    with pytest.raises(InputError, match="give all or none"):
        motion_main(sequence, flow, *made, MotionOptions(), *now, tmp_path / "then.arrow")
    assert not made[0].exists()
