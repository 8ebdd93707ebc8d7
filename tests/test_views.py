"""The views that are rendered beside the frames: a path around the scene, and the right eye."""

from pathlib import Path

import gaussian_scene as truth
import numpy as np
import pytest

from stages.render.options import RenderOptions
from stages.render.shots import Shot, even_moments, planned_shots, right_cameras
from stages.render.viewpoints import novel_path, right_eye
from stages.shared import lie
from stages.shared.cameras import make_cameras
from stages.shared.pace import seconds_per_frame
from stages.shared.sequences import Sequence
from stages.shared.sintel import write_cam


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


def test_views_of_a_lens_that_zooms_have_the_focal_length_of_their_moment() -> None:
    Ks = np.tile(truth.K, (truth.T, 1, 1))
    Ks[:, 0, 0] *= np.linspace(1, 1.5, truth.T)
    numbers = list(range(1, truth.T + 1))
    content = Sequence("zoom", [Path(f"{n}.png") for n in numbers], numbers, truth.WIDTH, truth.HEIGHT)
    cameras = make_cameras(truth.cameras(), Ks, np.array(numbers))
    shots = planned_shots(content, cameras, 3.0, RenderOptions(novel_views=truth.T))
    novel = [shot.K[0, 0] for shot in shots if shot.split == "novel"]
    assert novel == pytest.approx(Ks[:, 0, 0])


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


def test_the_fly_through_keeps_the_pace_of_the_video() -> None:
    times_s = [0, 0.1, 0.2, 0.6]  # frames are missing before the last one
    assert np.allclose(even_moments(times_s, 7), [0, 1 / 3, 2 / 3, 0.75, 2.5 / 3, 2.75 / 3, 1])
    assert even_moments(None, 5).tolist() == [0, 0.25, 0.5, 0.75, 1]
    assert seconds_per_frame(times_s, 7) == pytest.approx(0.1)
    assert (seconds_per_frame([0, 60], 7), seconds_per_frame([0, 0.01], 7)) == (0.2, 0.04)


def test_right_eyes_are_rendered_for_the_frames_that_have_one_on_disk(tmp_path: Path) -> None:
    left = lie.exp_se3(np.random.default_rng(0).normal(scale=0.3, size=(6, 6)))
    right = lie.from_parts(np.eye(3), np.array([-0.1, 0, 0])) @ left
    files: dict[str, dict[int, Path]] = {"camdata_left": {}, "camdata_right": {}}
    for kind, poses in (("camdata_left", left), ("camdata_right", right)):
        for k, pose in enumerate(poses):
            files[kind][10 + k] = tmp_path / f"{kind}_{k}.cam"
            write_cam(files[kind][10 + k], np.eye(3), pose[:3])
    files["clean_right"] = {12: tmp_path / "12.png", 13: tmp_path / "13.png"}
    numbers = list(range(10, 16))
    sequence = Sequence("clip", [tmp_path] * 6, numbers, 8, 8, files)
    rows, eyes = right_cameras(sequence, left)
    assert rows.tolist() == [0, 1, 2, 3, 4, 5]
    assert np.allclose(eyes, right, atol=1e-12)

    def shots() -> list[Shot]:
        planned = planned_shots(sequence, make_cameras(left, np.eye(3), np.array(numbers)), 3.0, RenderOptions(), 0.5)
        return [shot for shot in planned if shot.split == "right"]

    assert [shot.number for shot in shots()] == [12, 13]
    assert [shot.shutter for shot in shots()] == [None, None]  # the clean pass is sharp
    files["final_right"] = {13: tmp_path / "13.png"}
    (only,) = shots()
    assert (only.number, only.frame) == (13, 3)
    assert only.shutter is not None
    assert np.allclose(only.shutter.cam_from_world, right, atol=1e-12)
    assert np.allclose(only.cam_from_world, right[3], atol=1e-12)
    del files["camdata_left"][11]  # no scale without every left camera
    assert len(right_cameras(sequence, left)[0]) == 0
