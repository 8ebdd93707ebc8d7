"""Given cameras in the adjustment: lenses off the centre, poses held or as a start, files that mean something else."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ba_files import outputs, write_inputs
from numpy.testing import assert_allclose
from synthetic import Scene, flow_arrays, make_scene, observe, rotation_error_deg, trajectory_error

from stages.ba import readings
from stages.ba.__main__ import main
from stages.ba.options import BAOptions
from stages.shared import lie, sintel
from stages.shared.artifacts import read_dense, read_metadata, read_table, write_json
from stages.shared.cameras import intrinsics, make_cameras, pixel_grid, read_cameras, unproject, write_tum
from stages.shared.conventions import FLIP
from stages.shared.errors import InputError
from stages.shared.sequences import check_sequence, sequence_to_json

SIZE = (64, 96)
OFF_CENTRE = intrinsics(86.4, 1.15 * 86.4, 47.5 + 0.12 * 96, 31.5 - 4)
"""The principal point 12 % of the width to the right, pixels that are not square."""

WORLD = np.array([3.0, -2.0, 5.0, 0.3, -0.2, 0.5])
"""Twist of another world than the first camera."""


def solve(folder: Path, scene: Scene, noise_px: float = 0.0, **options: object) -> dict[str, Path]:
    """What the script writes for a scene with its masks; a trajectory of the truth lies in `folder` as true.tum."""
    source, target, flow, confidence = flow_arrays(scene)
    flow = flow + noise_px * np.random.default_rng(0).standard_normal(flow.shape)
    files = write_inputs(folder, (source, target, flow, confidence), scene.dynamic)
    main(**files, **(paths := outputs(folder / "out")), options=BAOptions(stride_px=4, **options))  # type: ignore[arg-type]
    return paths


def given(path: Path, poses: np.ndarray, K: np.ndarray) -> str:
    """The path of a trajectory of poses [T, 4, 4], and the path's lens beside it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_tum(path, make_cameras(poses, K, np.arange(len(poses))), list(range(1, len(poses) + 1)))
    return str(path)


def lens(K: np.ndarray) -> str:
    """`intrinsics:` of this K."""
    return ", ".join(f"{value:.17g}" for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A mover in a room, seen through the lens off the centre."""
    return make_scene(T=6, size=SIZE, disc_radius=0.6, K=OFF_CENTRE)


def test_a_lens_off_the_centre_costs_no_accuracy(scene: Scene, tmp_path: Path) -> None:
    """Against the twin through a centred lens with square pixels, of the same known focal length and flow noise."""
    twin = make_scene(T=6, size=SIZE, disc_radius=0.6)
    errors = {}
    for name, one in {"off": scene, "centred": twin}.items():
        paths = solve(tmp_path / name, one, noise_px=0.1, intrinsics=lens(one.K))
        cameras = read_cameras(paths["poses"])
        assert_allclose(cameras.Ks, np.broadcast_to(one.K, cameras.Ks.shape), rtol=1e-9)
        errors[name] = trajectory_error(cameras.cam_from_world, one.cam_from_world)
        assert rotation_error_deg(cameras.cam_from_world, one.cam_from_world) < 0.05
        assert read_metadata(paths["poses"])["focal"]["decision"] == "known"
        _depth_is_true(one, paths)
    assert errors["off"] < 1.5 * errors["centred"] < 5e-3
    taken_as_centred = solve(tmp_path / "wrong", scene, noise_px=0.1, intrinsics="86.4 px")
    wrong = trajectory_error(read_cameras(taken_as_centred["poses"]).cam_from_world, scene.cam_from_world)
    assert wrong > 2.5 * errors["off"]


def _depth_is_true(scene: Scene, paths: dict[str, Path]) -> None:
    """The points of the static pixels lie where they are, up to the scale of the scene."""
    depth, cameras = read_dense(paths["depth"]), read_cameras(paths["poses"])
    stride = read_metadata(paths["depth"])["stride_px"]
    pixels = pixel_grid(*depth["inverse_depth"].shape[1:]) * stride + (stride - 1) / 2
    u, v = np.rint(pixels).astype(int).transpose(2, 0, 1)
    for k in (0, scene.T - 1):
        known = (depth["filled"][k] == 0) & ~scene.dynamic[k][v, u]
        found = unproject(pixels, 1 / depth["inverse_depth"][k], np.eye(4), cameras.Ks[k])[known]
        true = unproject(pixels, scene.depth[k][v, u], np.eye(4), scene.K)[known]
        ratio = np.linalg.norm(found, axis=1) / np.linalg.norm(true, axis=1)
        assert np.percentile(np.abs(ratio / np.median(ratio) - 1), 80) < 0.05


def test_true_cameras_as_files_are_the_true_cameras(scene: Scene, tmp_path: Path) -> None:
    """A trajectory with a lens, and a transforms.json: what `poses_from: truth` writes, bit by bit but for rounding."""
    folder = tmp_path / "training" / "final" / "clip"
    files = write_inputs(tmp_path, flow_arrays(scene), scene.dynamic)
    folder.parent.mkdir(parents=True)
    (tmp_path / "clip").rename(folder)
    for k, pose in enumerate(scene.cam_from_world):
        path = tmp_path / "training" / "camdata_left" / "clip" / f"frame_{k + 1:04d}.cam"
        path.parent.mkdir(parents=True, exist_ok=True)
        sintel.write_cam(path, scene.K, pose[:3])
    write_json(files["sequence"], sequence_to_json(check_sequence("clip", folder)))
    moved = scene.cam_from_world @ lie.exp_se3(WORLD)
    moved[:, :3, 3] *= 7.0
    trajectory = given(tmp_path / "clip.tum", moved, scene.K).replace("clip.tum", "{sequence}.tum")
    transforms = tmp_path / "transforms.json"
    frames = [
        {"file_path": f"frame_{k + 1:04d}.png", "transform_matrix": (lie.inverse(pose) @ FLIP).tolist()}
        for k, pose in enumerate(moved)
    ]
    fx, fy, cx, cy = scene.K[0, 0], scene.K[1, 1], scene.K[0, 2] + 0.5, scene.K[1, 2] + 0.5
    camera = {"w": 96, "h": 64, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    transforms.write_text(json.dumps(camera | {"frames": frames}))
    tables = []
    for name, options in {
        "truth": {"poses_from": "truth"},
        "tum": {"poses_from": trajectory, "intrinsics": lens(scene.K)},
        "transforms": {"poses_from": str(transforms)},
    }.items():
        main(**files, **(paths := outputs(tmp_path / name)), options=BAOptions(stride_px=4, **options))  # type: ignore[arg-type]
        tables.append((read_table(paths["poses"]), read_dense(paths["depth"])["inverse_depth"]))
        assert trajectory_error(read_cameras(paths["poses"]).cam_from_world, scene.cam_from_world) < 1e-9
        assert read_metadata(paths["poses"])["flags"] == []
    for poses, depth in tables[1:]:
        for column in ("qw", "qx", "qy", "qz", "tx", "ty", "tz", "fx", "fy", "cx", "cy"):
            assert_allclose(poses[column], tables[0][0][column], atol=1e-6)
        assert_allclose(depth, tables[0][1], rtol=1e-3)


@pytest.mark.parametrize("motion", ["curve", "rotate"])
@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lie.inverse, "in the opposite direction .camera-to-world"),
        (lambda poses: FLIP @ poses, "with OpenGL axes .x right"),
        (lambda poses: lie.inverse(poses) @ FLIP, "in the opposite direction and with OpenGL axes"),
        (lambda poses: lie.inverse(poses @ lie.exp_se3(WORLD)), "in the opposite direction"),
    ],
)
def test_a_file_that_means_something_else_is_recognised(
    tmp_path: Path, motion: str, wrong: Callable[[np.ndarray], np.ndarray], said: str
) -> None:
    scene = make_scene(T=6, size=SIZE, motion=motion)
    path = given(tmp_path / "path.tum", wrong(scene.cam_from_world), scene.K)
    with pytest.raises(InputError, match=rf"path\.tum: expected poses that explain the flow, which these do {said}"):
        solve(tmp_path / "run", scene, noise_px=0.2, poses_from=path, intrinsics=lens(scene.K))
    assert not list((tmp_path / "run" / "out").glob("*"))


def test_a_straight_path_that_is_read_backwards_is_recognised(tmp_path: Path) -> None:
    """A camera that does not turn has the same epipolar lines both ways: depths would be negative."""
    path = np.tile(np.eye(4), (6, 1, 1))
    path[:, :3, 3] = np.arange(6)[:, None] * [-0.15, 0.02, -0.1]
    scene = make_scene(T=6, size=SIZE, path=path)
    file = given(tmp_path / "path.tum", lie.inverse(path), scene.K)
    with pytest.raises(InputError, match="which these do in the opposite direction"):
        solve(tmp_path / "run", scene, noise_px=0.2, poses_from=file, intrinsics=lens(scene.K))


def test_a_mover_over_most_of_the_view_does_not_refuse_true_poses() -> None:
    """Without masks, as in the first round: most matches are the mover's, and fit no reading."""
    scene = make_scene(T=6, size=SIZE, disc_radius=1.2)
    assert scene.dynamic.mean() > 0.65
    focals_px = np.full(6, scene.focal_px)
    graph = observe(scene, masked=False)
    assert readings.check(graph, "true.tum", scene.cam_from_world, focals_px, seed=0) == []
    with pytest.raises(InputError, match=r"wrong\.tum: expected poses"):
        readings.check(graph, "wrong.tum", lie.inverse(scene.cam_from_world), focals_px, seed=0)


def test_poses_of_another_clip_are_refused_and_poor_ones_are_flagged(scene: Scene, tmp_path: Path) -> None:
    other = np.tile(np.eye(4), (6, 1, 1))
    other[:, :3, :3] = lie.exp_so3(np.arange(6)[:, None] * [0.05, 0.02, 0.1])
    file = given(tmp_path / "other.tum", other, scene.K)
    with pytest.raises(InputError, match=r"px of residual at .* px of flow, and .* by any other reading; check that"):
        solve(tmp_path / "other", scene, poses_from=file, intrinsics=lens(scene.K))
    rng = np.random.default_rng(1)
    shaken = lie.exp_se3(rng.normal(0, 1, (6, 6)) * np.repeat([0.02, 0.012], 3)) @ scene.cam_from_world
    file = given(tmp_path / "shaken.tum", shaken, scene.K)
    paths = solve(tmp_path / "shaken", scene, poses_from=file, intrinsics=lens(scene.K))
    assert "given poses fit poorly: their residual is" in read_metadata(paths["poses"])["flags"][0]


def test_poses_to_start_from_are_adjusted_with_their_focal_length(tmp_path: Path) -> None:
    """Shaken poses, without intrinsics: the focal length is found too, where the lens is centred."""
    centred = make_scene(T=6, size=SIZE, disc_radius=0.6)
    rng = np.random.default_rng(1)
    shaken = lie.exp_se3(rng.normal(0, 1, (6, 6)) * np.repeat([0.01, 0.004], 3)) @ centred.cam_from_world
    file = given(tmp_path / "shaken.tum", shaken, centred.K)
    before = trajectory_error(shaken, centred.cam_from_world)
    for name, options in {"estimate": {}, "known": {"intrinsics": lens(centred.K)}}.items():
        paths = solve(tmp_path / name, centred, poses_from=file, poses_as="start", **options)
        cameras = read_cameras(paths["poses"])
        assert trajectory_error(cameras.cam_from_world, centred.cam_from_world) < min(0.1 * before, 5e-3)
        assert_allclose(cameras.Ks[:, 0, 0], centred.focal_px, rtol=0.02 if name == "estimate" else 1e-9)
        phases = read_table(paths["convergence"])["phase"]
        assert "given poses" in phases
        assert not any(phase.startswith("chain") for phase in phases)
    with pytest.raises(
        InputError, match="intrinsics for poses that are held fixed, found none in this file; set `intr"
    ):
        solve(tmp_path / "none", centred, poses_from=file)


def test_true_poses_without_intrinsics_are_not_doubted() -> None:
    """Their focal length is found to less than the noise, not picked from a list."""
    scene = make_scene(T=6, size=SIZE, disc_radius=0.6)
    graph = observe(scene, noise_px=0.02)
    focal_px = readings.best_focal(graph, scene.cam_from_world)
    assert_allclose(focal_px, scene.focal_px, rtol=0.01)
    assert readings.check(graph, "true.tum", scene.cam_from_world, np.full(6, focal_px), seed=0) == []


@pytest.mark.parametrize("motion", ["curve", "rotate"])
def test_intrinsics_of_frames_at_another_size_are_doubted(motion: str) -> None:
    """Those of a video 1920 px wide, whose frames are reduced to 1024 px; right ones and 7 % off are not."""
    scene = make_scene(T=6, size=SIZE, motion=motion)
    graph = observe(scene, noise_px=0.02)
    for factor in (0.93, 1.0, 1.07):
        assert readings.doubts_about_lens(graph, factor * scene.focal_px, seed=0) == []
    doubts = readings.doubts_about_lens(graph, 1.875 * scene.focal_px, seed=0)
    assert len(doubts) == 1
    assert doubts[0].startswith("the given focal length fits poorly")
    moved = readings.doubts_about_lens(replace(graph, centre=graph.centre * 1.875), scene.focal_px, seed=0)
    assert moved[0].startswith("the given principal point is 43% of the frame from its middle")


def test_poses_held_fixed_keep_a_zoom(tmp_path: Path) -> None:
    """A transforms.json with a focal length per frame."""
    zoom = np.geomspace(0.8, 1.25, 6)
    scene = make_scene(T=6, size=SIZE, zoom=zoom)
    frames = [
        {
            "file_path": f"images/frame_{k + 1:04d}.jpg",
            "transform_matrix": (lie.inverse(pose) @ FLIP).tolist(),
            "fl_x": float(scene.K_of(k)[0, 0]),
        }
        for k, pose in enumerate(scene.cam_from_world)
    ]
    (tmp_path / "transforms.json").write_text(json.dumps({"w": 96, "h": 64, "frames": frames}))
    paths = solve(tmp_path / "run", scene, poses_from=str(tmp_path / "transforms.json"))
    cameras = read_cameras(paths["poses"])
    assert_allclose(cameras.Ks[:, 0, 0], scene.focal_px * zoom, rtol=1e-9)
    assert trajectory_error(cameras.cam_from_world, scene.cam_from_world) < 1e-9
    assert read_metadata(paths["poses"])["residual_px"] < 0.05
