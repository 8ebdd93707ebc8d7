"""Rounds that begin as the round before began: told by the flow of the static scene, and carried over as files."""

from pathlib import Path

import numpy as np
import pytest
from synthetic import Scene, make_scene
from test_motion_script import write_inputs

from stages.motion.__main__ import main as motion_main
from stages.motion.options import MotionOptions
from stages.segment.__main__ import main as segment_main
from stages.segment.options import SegmentOptions
from stages.shared import lie
from stages.shared.artifacts import read_dense, write_dense
from stages.shared.cameras import make_cameras, write_cameras
from stages.shared.errors import InputError
from stages.shared.images import read_mask
from stages.shared.settled import SAME_PX, is_settled

STRIDE = 8


def write_round(
    folder: Path,
    scene: Scene,
    turn_px: float = 0.0,
    focal: float = 1.0,
    nearer: float = 0.0,
    begun: bool = True,
    status: str = "estimated",
) -> tuple[Path, Path]:
    """Poses and depth of a round. Every other camera is turned by so many px; the lens is `focal` times as long; a
    share of the columns is twice as near; `begun`: with the poses of a round before."""
    folder.mkdir(parents=True, exist_ok=True)
    K, turns = scene.K.copy(), np.zeros((scene.T, 6))
    K[:2, :2] *= focal
    turns[::2, 4] = turn_px / K[0, 0]
    numbers, statuses = np.arange(1, scene.T + 1), np.full(scene.T, status, object)
    cameras = make_cameras(lie.exp_se3(turns) @ scene.cam_from_world, K, numbers, status=statuses)
    write_cameras(folder / "poses.parquet", cameras, {"from_previous_round": begun})
    half = STRIDE // 2
    depth = np.stack([frame[half::STRIDE, half::STRIDE] for frame in scene.depth]).astype(np.float32)
    depth[:, :, : round(nearer * depth.shape[2])] /= 2
    write_dense(folder / "depth.arrow", {"frame": numbers, "inverse_depth": 1 / depth}, {"stride_px": STRIDE})
    return folder / "poses.parquet", folder / "depth.arrow"


@pytest.mark.parametrize(
    ("changed", "settled"),
    [
        ({}, True),
        ({"turn_px": 0.8 * SAME_PX}, True),
        ({"turn_px": 1.5 * SAME_PX}, False),
        ({"focal": 1.3}, False),
        ({"nearer": 0.4}, True),
        ({"nearer": 0.7}, False),
        ({"begun": False}, False),
        ({"status": "failed"}, False),
    ],
)
def test_two_rounds_are_alike_if_most_of_the_static_scene_flows_alike(
    changed: dict, settled: bool, tmp_path: Path
) -> None:
    """What is nearer in fewer than half of the pixels may be a mover, whose depth says nothing of the cameras."""
    scene = make_scene()
    then, now = write_round(tmp_path / "then", scene), write_round(tmp_path / "now", scene, **changed)
    assert is_settled(now, then, scale=1.0) == settled
    assert is_settled(then, now, scale=1.0) == settled


def test_flow_is_compared_in_pixels_of_its_grid(tmp_path: Path) -> None:
    scene = make_scene()
    then, now = write_round(tmp_path / "then", scene), write_round(tmp_path / "now", scene, turn_px=1.5 * SAME_PX)
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


def test_results_without_the_cameras_that_they_began_with_are_refused(tmp_path: Path) -> None:
    scene = make_scene()
    (sequence, flow), now = write_inputs(tmp_path, scene), write_round(tmp_path / "now", scene)
    made = tmp_path / "prior.arrow", tmp_path / "prior.png"
    with pytest.raises(InputError, match="give all or none"):
        motion_main(sequence, flow, *made, MotionOptions(), *now, tmp_path / "then.arrow")
    assert not made[0].exists()
