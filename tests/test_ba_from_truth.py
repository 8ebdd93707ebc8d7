"""True poses and true depth in place of estimated ones."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic import Scene, exact_flow, make_scene, observe, trajectory_error

from stages.ba import from_truth, given
from stages.ba.depth import DepthMaps
from stages.shared import lie, sintel
from stages.shared.cameras import pixel_grid, project, unproject
from stages.shared.errors import InputError
from stages.shared.sequences import Sequence

UNIT = 30.0
"""Of the truth: the solver's gauge must not care."""


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A mover in a room, in another unit and with a world that is not the first camera's."""
    plain = make_scene(T=6, disc_radius=0.5, scale=UNIT)
    world = lie.exp_se3(np.array([3.0, -2.0, 5.0, 0.3, -0.2, 0.5]))
    return replace(plain, cam_from_world=plain.cam_from_world @ world)


@pytest.fixture
def frames(scene: Scene, tmp_path: Path) -> Sequence:
    """The scene's truth on disk, in MPI-Sintel's formats."""
    truth: dict[str, dict[int, Path]] = {"camdata_left": {}, "depth": {}}
    for k in range(scene.T):
        truth["camdata_left"][k + 1] = tmp_path / f"{k + 1}.cam"
        truth["depth"][k + 1] = tmp_path / f"{k + 1}.dpt"
        sintel.write_cam(tmp_path / f"{k + 1}.cam", scene.K, scene.cam_from_world[k, :3])
        sintel.write_dpt(tmp_path / f"{k + 1}.dpt", scene.depth[k])
    numbers = list(range(1, scene.T + 1))
    return Sequence("clip", [tmp_path / f"{n}.png" for n in numbers], numbers, 96, 64, truth)


def test_true_poses_keep_their_path_and_true_depth_explains_the_flow(scene: Scene, frames: Sequence) -> None:
    solution = given.solve_depths(observe(scene, masked=False), from_truth.true_poses(frames), scene.focal_px, seed=0)
    poses = solution.state.cam_from_world
    assert trajectory_error(poses, scene.cam_from_world) < 1e-9
    assert np.allclose(poses[0], np.eye(4), atol=1e-12)
    assert np.median(solution.state.inverse_depth) == pytest.approx(1)  # the gauge that the metadata states
    shape = (scene.T, 32, 48)
    unknown = DepthMaps(np.ones(shape), np.ones(shape), np.ones(shape, bool))
    maps = from_truth.true_depth_maps(
        frames, unknown, 2.0, from_truth.gauge_scale(solution.state, scene.cam_from_world)
    )
    pixels = pixel_grid(32, 48) * 2 + 0.5
    world = unproject(pixels, 1 / maps.inverse_depth[0], poses[0], scene.K)
    found = project(world, poses[2], scene.K)[0] - pixels
    flow, _ = exact_flow(scene, 0, 2)
    errors_px = np.linalg.norm(found - flow[::2, ::2], axis=-1)[~scene.dynamic[0][::2, ::2]]
    assert np.median(errors_px) < 0.1  # the grid is half a pixel off
    assert not maps.filled.any()


def test_true_depth_takes_the_scale_of_estimated_poses(frames: Sequence) -> None:
    true = np.stack([1 / depth[::2, ::2] for depth in from_truth.true_depths(frames)])
    rng = np.random.default_rng(0)
    estimated = 7.0 * true * np.exp(0.05 * rng.standard_normal(true.shape))
    filled = rng.random(true.shape) < 0.4
    estimated[filled] = 100.0  # guesses have no say
    maps = from_truth.true_depth_maps(frames, DepthMaps(estimated, np.ones(true.shape), filled), 2.0, None)
    assert np.median(maps.inverse_depth / true) == pytest.approx(7.0, rel=0.01)


def test_the_sky_has_a_small_positive_inverse_depth(frames: Sequence) -> None:
    for path in frames.truth["depth"].values():
        depth = sintel.read_dpt(path)
        depth[:10] = np.inf
        sintel.write_dpt(path, depth)
    ones = np.ones((6, 64, 96))
    maps = from_truth.true_depth_maps(frames, DepthMaps(ones, ones, ones < 0), 1.0, None)
    assert np.all(maps.inverse_depth[:, :10] == from_truth.MIN_INVERSE_DEPTH)
    assert np.all(maps.variance > 0)


def test_a_camera_that_only_turns_is_called_so() -> None:
    turning = make_scene(T=5, motion="rotate")
    solution = given.solve_depths(observe(turning, stride=8), turning.cam_from_world, turning.focal_px, seed=0)
    assert solution.camera == "rotating"
    assert np.isfinite(solution.state.cam_from_world).all()
    assert from_truth.gauge_scale(solution.state, turning.cam_from_world) is None


@pytest.mark.parametrize(("kind", "option"), [("camdata_left", "poses_from"), ("depth", "depth_from")])
def test_missing_truth_is_named(frames: Sequence, kind: str, option: str) -> None:
    del frames.truth[kind][2]
    read = from_truth.true_poses if kind == "camdata_left" else from_truth.true_depths
    with pytest.raises(InputError, match=f"{kind} beside the frames.*{option}: truth.*{option}: estimate"):
        read(frames)
