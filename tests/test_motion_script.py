"""The script of the motion prior: what it reads of the round before, and what it refuses."""

from pathlib import Path

import numpy as np
import pytest
from conftest import write_frames
from synthetic import Scene, make_scene
from test_motion import observed, overlap

from stages.motion import __main__ as motion_stage
from stages.shared.artifacts import read_dense, read_metadata, write_dense, write_json
from stages.shared.cameras import make_cameras, write_cameras
from stages.shared.errors import InputError
from stages.shared.sequences import check_sequence, sequence_to_json


def write_inputs(folder: Path, scene: Scene) -> tuple[Path, Path]:
    """sequence.json and pairs.arrow of a scene (frames are noise: only the figure shows them)."""
    clip = write_frames(folder / "clip", scene.T, scene.depth.shape[1:])
    write_json(folder / "sequence.json", sequence_to_json(check_sequence("clip", clip)))
    pairs = observed(scene)
    columns = {name: pairs.columns[name] for name in ("source", "target")}
    columns |= {name: pairs.columns[name].astype(np.float16) for name in ("flow", "confidence")}
    write_dense(folder / "pairs.arrow", columns, {"width": 96, "height": 64, "scale": 1.0})
    return folder / "sequence.json", folder / "pairs.arrow"


def write_round(folder: Path, scene: Scene, status: str = "estimated") -> tuple[Path, Path]:
    """The poses and depth of a round before."""
    numbers = np.arange(1, scene.T + 1)
    statuses = np.full(scene.T, status, object)
    write_cameras(folder / "poses.parquet", make_cameras(scene.cam_from_world, scene.K, numbers, status=statuses))
    depth = np.full((scene.T, 8, 12), 0.2, np.float32)
    write_dense(folder / "depth.arrow", {"frame": numbers, "inverse_depth": depth}, {"stride_px": 8})
    return folder / "poses.parquet", folder / "depth.arrow"


def test_script_uses_cameras_when_there_are_any(tmp_path: Path) -> None:
    scene = make_scene(disc_radius=0.5)
    inputs, poses = write_inputs(tmp_path, scene), write_round(tmp_path, scene)
    output = tmp_path / "prior.arrow"
    motion_stage.main(*inputs, output, tmp_path / "motion.png", motion_stage.MotionOptions(), *poses)
    assert read_metadata(output)["source"] == "cameras"
    probability = read_dense(output)["probability"]
    assert probability.dtype == np.float16
    assert overlap(probability > 0.5, scene.dynamic) > 0.7


def test_nothing_is_told_of_frames_without_a_pose(tmp_path: Path) -> None:
    """Under poses that are not theirs all of them would seem to move, and the noise of the others too high."""
    scene = make_scene(disc_radius=0.5)
    inputs, (poses, depth) = write_inputs(tmp_path, scene), write_round(tmp_path, scene)
    cam_from_world, status = scene.cam_from_world.copy(), np.array(["estimated"] * 5 + ["unobserved"] * 3, object)
    cam_from_world[5:] = cam_from_world[4]
    write_cameras(poses, make_cameras(cam_from_world, scene.K, np.arange(1, 9), status=status))
    output = tmp_path / "prior.arrow"
    motion_stage.main(*inputs, output, tmp_path / "motion.png", motion_stage.MotionOptions(), poses, depth)
    probability = read_dense(output)["probability"]
    assert (probability[5:] > 0.5)[~scene.dynamic[5:]].mean() < 0.05
    assert overlap(probability[:5] > 0.5, scene.dynamic[:5]) > 0.7


def test_script_falls_back_to_flow_when_the_cameras_failed(tmp_path: Path) -> None:
    scene = make_scene(T=4, disc_radius=0.5)
    inputs, poses = write_inputs(tmp_path, scene), write_round(tmp_path, scene, "failed")
    motion_stage.main(*inputs, tmp_path / "prior.arrow", tmp_path / "motion.png", motion_stage.MotionOptions(), *poses)
    assert read_metadata(tmp_path / "prior.arrow")["source"] == "flow"


def test_script_refuses_poses_without_depth(tmp_path: Path) -> None:
    scene = make_scene(T=4)
    inputs, (poses, _) = write_inputs(tmp_path, scene), write_round(tmp_path, scene)
    with pytest.raises(InputError, match="together with --previous-depth"):
        motion_stage.main(
            *inputs, tmp_path / "prior.arrow", tmp_path / "motion.png", motion_stage.MotionOptions(), poses
        )
    assert not (tmp_path / "prior.arrow").exists()
