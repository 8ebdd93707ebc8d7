"""Cameras: projection and back, pixel centres when an image is resized, tables and TUM files."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from stages.shared import lie
from stages.shared.cameras import (
    centred_intrinsics,
    frame_from_grid,
    grid_from_frame,
    intrinsics,
    make_cameras,
    pixel_grid,
    project,
    projection,
    read_cameras,
    scale_intrinsics,
    static_flow,
    unproject,
    write_cameras,
    write_tum,
)


def random_cameras(T: int = 5) -> np.ndarray:
    """Poses [T, 4, 4] all over SE(3)."""
    return lie.exp_se3(np.random.default_rng(0).normal(size=(T, 6)))


def test_unproject_inverts_project() -> None:
    pose, K = random_cameras(1)[0], intrinsics(80.0, 90.0, 31.0, 17.0)
    uv = pixel_grid(36, 64)
    depth = np.random.default_rng(1).uniform(0.5, 9, (36, 64))
    pixels, z = project(unproject(uv, depth, pose, K), pose, K)
    assert_allclose(pixels, uv, atol=1e-10)
    assert_allclose(z, depth, rtol=1e-12)


def test_projection_equals_opencv() -> None:
    pose, K = random_cameras(1)[0], intrinsics(80.0, 90.0, 31.0, 17.0)
    points = unproject(pixel_grid(4, 4), np.full((4, 4), 3.0), pose, K).reshape(-1, 3)
    expected, _ = cv2.projectPoints(points, lie.log_so3(pose[:3, :3]), pose[:3, 3], K, None)
    assert_allclose(project(points, pose, K)[0], expected[:, 0], atol=1e-9)


def test_static_flow_is_where_opencv_sees_the_same_points() -> None:
    source, target = random_cameras(2)
    K, other_K = intrinsics(80.0, 90.0, 31.0, 17.0), intrinsics(70.0, 71.0, 33.0, 20.0)
    uv, depth = pixel_grid(36, 64), np.random.default_rng(1).uniform(0.5, 9, (36, 64))
    points = unproject(uv, depth, source, K).reshape(-1, 3)
    expected, _ = cv2.projectPoints(points, lie.log_so3(target[:3, :3]), target[:3, 3], other_K, None)
    ahead = (points @ target[2, :3] + target[2, 3]).reshape(depth.shape)
    assert (ahead > 0).any()
    assert (ahead < 0).any()
    A, b = projection((source, K), (target, other_K))
    flow, ratio = static_flow(uv, 1 / depth, A, b)
    assert_allclose(ratio, ahead / depth, atol=1e-12)
    seen = ahead > 0.1
    assert_allclose((uv + flow)[seen], expected.reshape(36, 64, 2)[seen], rtol=1e-9)
    assert_allclose(static_flow(uv, 0 * depth, A, b)[0], static_flow(uv, 1 / depth, A, 0 * b)[0])  # far away, or turned


@pytest.mark.parametrize("factor", [0.5, 0.25, 2.0])
def test_scaled_intrinsics_follow_the_pixels_of_a_resized_image(factor: float) -> None:
    h, w = 48, 64
    ramp = pixel_grid(h, w)[..., 0].astype(np.float32)
    resized = cv2.resize(ramp, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    K = centred_intrinsics(70.0, w, h)
    scaled = scale_intrinsics(K, factor)
    column = resized.shape[1] // 2 + 3
    # The ray of a resized pixel is the ray of the mean column that it covers.
    ray = (column - scaled[0, 2]) / scaled[0, 0]
    assert ray == pytest.approx((resized[0, column] - K[0, 2]) / K[0, 0], abs=0.26 / 70)
    if factor < 1:
        assert ray == pytest.approx((resized[0, column] - K[0, 2]) / K[0, 0], abs=1e-6)
    assert_allclose(scale_intrinsics(scaled, 1 / factor), K, atol=1e-12)
    assert_allclose(scaled[:2, 2], [(w * factor - 1) / 2, (h * factor - 1) / 2])


def test_a_table_of_cameras_is_read_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    covariance = rng.normal(size=(5, 6, 6))
    K = centred_intrinsics(70.0, 64, 48)
    status = ["estimated", "estimated", "unobserved", "estimated", "failed"]
    cameras = make_cameras(random_cameras(), K, np.arange(3, 8), covariance, np.array(status, object))
    write_cameras(tmp_path / "poses.parquet", cameras)
    read = read_cameras(tmp_path / "poses.parquet")
    assert_allclose(read.cam_from_world, cameras.cam_from_world, atol=1e-12)
    assert_allclose(read.Ks, cameras.Ks)
    assert_allclose(read.covariance, covariance)
    assert read.numbers.tolist() == [3, 4, 5, 6, 7]
    assert list(read.status) == status


def test_evo_reads_the_same_trajectory(tmp_path: Path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface")
    cameras = make_cameras(random_cameras(), np.eye(3), np.arange(1, 6))
    write_tum(tmp_path / "trajectory.tum", cameras, [0, 1 / 30, 2 / 30, 0.1, 0.2])
    trajectory = file_interface.read_tum_trajectory_file(str(tmp_path / "trajectory.tum"))
    assert_allclose(trajectory.positions_xyz, cameras.centres, atol=1e-12)
    assert_allclose(np.stack(trajectory.poses_se3), lie.inverse(cameras.cam_from_world), atol=1e-12)
    assert trajectory.timestamps.tolist() == [0, 1 / 30, 2 / 30, 0.1, 0.2]


def test_centres_are_where_the_camera_sees_itself_at_zero() -> None:
    cameras = make_cameras(random_cameras(), np.eye(3), np.arange(5))
    homogeneous = np.concatenate([cameras.centres, np.ones((5, 1))], axis=1)
    assert_allclose(np.einsum("tab,tb->ta", cameras.cam_from_world, homogeneous)[:, :3], 0, atol=1e-12)


@pytest.mark.parametrize(("distrusted", "used"), [([], 5), ([1, 2], 3), ([0, 1, 2], 5), (range(5), 5)])
def test_masks_are_left_out_while_most_are_trusted(distrusted: list[int], used: int, tmp_path: Path) -> None:
    """Where few are left to tell what moves, poor masks are better than none."""
    trusted = ~np.isin(np.arange(5), list(distrusted))
    write_cameras(tmp_path / "a", make_cameras(random_cameras(), np.eye(3), np.arange(5), masks_trusted=trusted))
    cameras = read_cameras(tmp_path / "a")
    np.testing.assert_array_equal(cameras.masks_trusted, trusted)
    assert cameras.masks_used.sum() == used
    assert not cameras.masks_used[list(distrusted)].any() or used == 5


@pytest.mark.parametrize("stride_px", [2, 5, 6.671875])
def test_the_pixels_of_a_grid_are_the_centres_of_what_they_cover(stride_px: float) -> None:
    """Grid pixel k covers the frame from s k - 0.5 to s (k + 1) - 0.5, as areas of pixels are."""
    k = np.arange(9.0)
    at = frame_from_grid(k, stride_px)
    edges = stride_px * np.arange(10) - 0.5
    assert_allclose(at, (edges[:-1] + edges[1:]) / 2)
    assert_allclose(grid_from_frame(at, stride_px), k, atol=1e-12)


def test_the_grid_is_where_opencv_averages_the_frame() -> None:
    """Area means of a ramp are its values at the centres of the areas."""
    u = pixel_grid(24, 36)[..., 0]
    reduced = cv2.resize(u, None, fx=1 / 3, fy=1 / 3, interpolation=cv2.INTER_AREA)
    assert_allclose(reduced, frame_from_grid(pixel_grid(8, 12), 3)[..., 0], atol=1e-9)
