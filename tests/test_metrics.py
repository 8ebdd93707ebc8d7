"""Scores against independent oracles: evo, kornia, and cases worked by hand."""

from pathlib import Path

import finished_run as run
import kornia
import numpy as np
import pytest
import torch
from conftest import write_frames
from evo.core import metrics as evo_metrics
from evo.core.geometry import GeometryException
from evo.core.trajectory import PosePath3D

from stages.evaluate import flow_check, image_metrics, mask_metrics, trajectory
from stages.evaluate.ground_truth import moving_pixels
from stages.evaluate.score_images import score_frame, true_images
from stages.shared import lie, sintel
from stages.shared.alignment import DegenerateError
from stages.shared.cameras import pixel_grid
from stages.shared.sequences import check_sequence


def _evo(estimated: np.ndarray, true: np.ndarray) -> tuple[float, float, float]:
    """ATE, RPE translation and RPE rotation in degrees by evo, from cam_from_world [T, 4, 4]."""
    reference = PosePath3D(poses_se3=list(lie.inverse(true)))
    path = PosePath3D(poses_se3=list(lie.inverse(estimated)))
    path.align(reference, correct_scale=True)
    found = []
    relation = evo_metrics.PoseRelation
    for metric in (
        evo_metrics.APE(relation.translation_part),
        evo_metrics.RPE(relation.translation_part, 1, evo_metrics.Unit.frames, all_pairs=True),
        evo_metrics.RPE(relation.rotation_angle_deg, 1, evo_metrics.Unit.frames, all_pairs=True),
    ):
        metric.process_data((reference, path))
        found.append(metric.get_statistic(evo_metrics.StatisticsType.rmse))
    return found[0], found[1], found[2]


def _assert_equal_to_evo(estimated: np.ndarray, true: np.ndarray) -> None:
    errors = trajectory.pose_errors(estimated, true, np.arange(len(true)))
    found = errors.ate, errors.rpe_trans, errors.rpe_rot_deg
    np.testing.assert_allclose(found, _evo(estimated, true), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_pose_errors_equal_evo_on_random_trajectories(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = lie.exp_se3(rng.normal(size=(30, 6)))
    estimated = lie.exp_se3(0.1 * rng.normal(size=(30, 6))) @ true @ lie.exp_se3(rng.normal(size=6))
    estimated[:, :3, 3] *= rng.uniform(0.1, 10)
    _assert_equal_to_evo(estimated, true)


def test_pose_errors_equal_evo_on_unrelated_and_planar_trajectories() -> None:
    rng = np.random.default_rng(1)
    _assert_equal_to_evo(lie.exp_se3(rng.normal(size=(12, 6))), lie.exp_se3(rng.normal(size=(12, 6))))
    planar = lie.exp_se3(rng.normal(size=(12, 6)) * [1, 0, 1, 0, 1, 0])
    _assert_equal_to_evo(lie.exp_se3(0.01 * rng.normal(size=(12, 6))) @ planar, planar)


@pytest.mark.parametrize("name", ["alley_walk", "temple_orbit", "mountain_static"])
def test_pose_errors_equal_evo_on_rendered_sequences(rendered: Path, name: str) -> None:
    files = sorted((rendered / "training" / "camdata_left" / name).glob("*.cam"))
    _, true = sintel.read_cams(files)
    noise = np.random.default_rng(2).normal(size=(len(true), 6))
    _assert_equal_to_evo(lie.exp_se3(0.01 * noise) @ true, true)


def _turning_at(centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A noisy estimate and the truth, cam_from_world [8, 4, 4], of a camera that turns at these centres [8, 3]."""
    rng = np.random.default_rng(3)
    true = lie.inverse(lie.from_parts(lie.exp_so3(rng.normal(size=(8, 3))), centres))
    return lie.exp_se3(0.1 * rng.normal(size=(8, 6))) @ true, true


def test_static_truth_is_degenerate_for_us_and_for_evo() -> None:
    estimated, true = _turning_at(np.zeros((8, 3)))
    with pytest.raises(DegenerateError, match="point"):
        trajectory.pose_errors(estimated, true, np.arange(8))
    with pytest.raises(GeometryException):
        _evo(estimated, true)


def test_straight_truth_is_degenerate() -> None:
    """evo's absolute test takes the rounding of such a line for a second direction."""
    estimated, true = _turning_at(np.outer(np.arange(8.0), [1, 2, 3]))
    with pytest.raises(DegenerateError, match="line"):
        trajectory.pose_errors(estimated, true, np.arange(8))


def test_pose_errors_do_not_depend_on_the_gauge() -> None:
    rng = np.random.default_rng(4)
    true = lie.exp_se3(rng.normal(size=(10, 6)))
    estimated = lie.exp_se3(0.1 * rng.normal(size=(10, 6))) @ true
    moved = estimated @ lie.exp_se3(rng.normal(size=6))
    moved[:, :3, 3] *= 7.0
    first, second = (trajectory.pose_errors(e, true, np.arange(10)) for e in (estimated, moved))
    assert (first.ate, first.rpe_trans) == pytest.approx((second.ate, second.rpe_trans), rel=1e-10)


def test_a_gap_between_registered_frames_is_no_pair() -> None:
    true = lie.exp_se3(np.random.default_rng(5).normal(size=(5, 6)))
    errors = trajectory.pose_errors(true, true, np.array([1, 2, 5, 6, 9]))
    assert errors.pairs.tolist() == [[0, 1], [2, 3]]
    assert errors.rpe_rot_deg == pytest.approx(0, abs=1e-5)


def test_psnr_and_ssim_equal_kornia() -> None:
    rng = np.random.default_rng(0)
    truth = rng.random((40, 50, 3))
    image = np.clip(truth + 0.1 * rng.normal(size=truth.shape), 0, 1)
    x, y = (torch.from_numpy(a).permute(2, 0, 1)[None] for a in (image, truth))
    assert image_metrics.psnr(image, truth) == pytest.approx(kornia.metrics.psnr(x, y, 1.0).item(), rel=1e-9)
    oracle = kornia.metrics.ssim(x, y, window_size=11, padding="valid", eps=0.0).mean().item()
    assert image_metrics.ssim_map(image, truth).mean() == pytest.approx(oracle, rel=1e-6)


def test_psnr_by_hand() -> None:
    assert image_metrics.psnr(np.full((4, 4, 3), 0.1), np.zeros((4, 4, 3))) == pytest.approx(20)


def test_equal_images_leave_a_mean_over_frames_finite() -> None:
    """The error of rounding to 8 bits, measured, is the least that counts: equal frames are that near and no nearer."""
    grey = np.full((8, 8, 3), 0.5)
    equal = image_metrics.psnr(grey, grey)
    exact = np.random.default_rng(0).random((64, 64, 3))
    rounded = np.round(exact * 255) / 255
    assert equal == pytest.approx(image_metrics.psnr(rounded, exact), abs=0.1)
    assert np.mean([equal, image_metrics.psnr(grey, grey + 0.1)]) == pytest.approx((58.92 + 20) / 2, abs=0.01)


def test_region_scores_see_only_their_region() -> None:
    truth = np.random.default_rng(0).integers(0, 255, (40, 60, 3), dtype=np.uint8)
    mask = np.zeros((40, 60), bool)
    mask[:, 30:] = True
    image = np.where(mask[..., None], 255 - truth, truth)
    scores = score_frame(image, truth, mask)
    assert scores["static"][0] == pytest.approx(58.92, abs=0.01)
    assert scores["dynamic"][0] < scores["whole"][0]
    assert set(score_frame(image, truth, np.zeros_like(mask))) == {"whole", "static"}


def test_iou_by_hand() -> None:
    mask, truth = np.zeros((10, 10), bool), np.zeros((10, 10), bool)
    assert mask_metrics.iou(mask, truth) == 1
    mask[:4, :5], truth[2:6, :5] = True, True
    assert mask_metrics.iou(mask, truth) == pytest.approx(10 / 30)
    assert mask_metrics.iou(mask, np.zeros_like(mask)) == 0


def test_precision_and_recall_are_over_all_frames_together() -> None:
    moving, called = np.zeros((2, 10, 10), bool), np.zeros((2, 10, 10), bool)
    moving[0, :4], called[0, 2:4], called[1, 0] = True, True, True
    # 30 pixels are called, 20 of them move; 40 move.
    assert mask_metrics.precision_recall(zip(called, moving, strict=True)) == (pytest.approx(2 / 3), 0.5)
    assert mask_metrics.precision_recall((mask, np.zeros((10, 10), bool)) for mask in called) == (0, None)
    assert mask_metrics.precision_recall([]) == (None, None)


def test_boundary_f_by_hand() -> None:
    """The tolerance of a 300 x 400 image is ceil(0.008 * 500) = 4 px."""
    truth = np.zeros((300, 400), bool)
    truth[100:200, 100:200] = True
    near, far, longer = np.roll(truth, 4, axis=1), np.roll(truth, 40, axis=1), truth.copy()
    longer[100:200, 200:320] = True
    assert mask_metrics.boundary_f(truth, truth) == 1
    assert mask_metrics.boundary_f(near, truth) == 1
    assert mask_metrics.boundary_f(np.roll(truth, 60, axis=(0, 1)), truth) < 0.1
    shared = 2 * (
        60 + 4 + 5
    )  # of top and of bottom: what overlaps, its end within 4 px, the first 5 px round the corner
    assert mask_metrics.boundary_f(far, truth) == pytest.approx(shared / 400, abs=0.01)
    precision, recall = 308 / 640, 308 / 400  # the right side is lost but for 4 px at each corner
    expected = 2 * precision * recall / (precision + recall)
    assert mask_metrics.boundary_f(longer, truth) == pytest.approx(expected, abs=0.02)
    assert mask_metrics.boundary_f(np.zeros_like(truth), truth) == 0
    assert mask_metrics.boundary_f(np.zeros_like(truth), np.zeros_like(truth)) == 1


def test_flow_residual_is_zero_for_the_truth_and_measures_a_wrong_pose() -> None:
    uv = pixel_grid(run.H, run.W).reshape(-1, 2)
    points, depth = run.wall(2)
    still = ~run.moving(points, 2).ravel()
    flow_px = run.flow(2, 3).reshape(-1, 2)
    source, target = ((run.CAM_FROM_WORLD[k], run.K) for k in (2, 3))
    exact = flow_check.flow_residuals(uv[still], 1 / depth.ravel()[still], flow_px[still], source, target)
    assert len(exact) == still.sum()
    assert exact.max() < 1e-9
    shifted = target[1] + np.array([[0, 0, 3.0], [0, 0, 4.0], [0, 0, 0]])
    wrong = flow_check.flow_residuals(uv[still], 1 / depth.ravel()[still], flow_px[still], source, (target[0], shifted))
    np.testing.assert_allclose(wrong, 5, atol=1e-9)


def test_flow_residual_leaves_out_points_behind_the_target() -> None:
    backwards = run.CAM_FROM_WORLD[0].copy()
    backwards[2, 3] -= 100
    uv = pixel_grid(4, 4).reshape(-1, 2)
    found = flow_check.flow_residuals(uv, np.ones(16), np.zeros((16, 2)), (np.eye(4), run.K), (backwards, run.K))
    assert len(found) == 0


def test_motion_masks_follow_from_true_flow_depth_and_cameras() -> None:
    points, depth = run.wall(1)
    source, target = ((run.CAM_FROM_WORLD[k], run.K) for k in (1, 2))
    found = moving_pixels(run.flow(1, 2), depth, source, target)
    np.testing.assert_array_equal(found, run.moving(points, 1))


def test_the_right_eye_is_compared_with_the_pass_of_the_frames(tmp_path: Path) -> None:
    """Fog and exposure of the final pass are no error of the scene, nor are those that the clean pass lacks."""
    for kind in ("final", "clean", "clean_right", "final_right"):
        write_frames(tmp_path / kind / "clip")
    for name, kind in (("final", "final_right"), ("clean", "clean_right")):
        sequence = check_sequence("clip", tmp_path / name / "clip")
        assert {path.parent.parent.name for path in true_images(sequence, "right").values()} == {kind}
    for path in (tmp_path / "final_right" / "clip").iterdir():
        path.unlink()
    sequence = check_sequence("clip", tmp_path / "final" / "clip")  # as in MPI-Sintel, which has a clean right eye only
    assert {path.parent.parent.name for path in true_images(sequence, "right").values()} == {"clean_right"}
