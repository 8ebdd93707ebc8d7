"""The evaluation of a run with known errors: what each table must say."""

from dataclasses import replace
from pathlib import Path

import finished_run as run
import numpy as np
import pytest

from stages.evaluate import costs, pose_diagnostics, pose_statistics, score_geometry, score_models, score_poses
from stages.evaluate.figure import draw_paths
from stages.report import overview
from stages.shared import lie
from stages.shared.artifacts import read_dense, read_metadata, read_model, write_model
from stages.shared.cameras import Cameras, make_cameras, read_cameras, write_cameras
from stages.shared.masks import read_masks
from stages.shared.run_inputs import RunInputs, read_run_inputs
from stages.shared.sequences import read_sequence
from stages.shared.tables import read_rows


def _candidate(cameras: Cameras | None, failure: str | None = None) -> score_poses.Candidate:
    return score_poses.Candidate("ours", "test", run.T, cameras, failure, 1.0, 1.0, 1)


def test_degenerate_truth_is_labelled_and_keeps_its_rotation_error() -> None:
    still = lie.from_parts(run.TURNS, np.zeros((run.T, 3)))
    truth = make_cameras(still, run.K, np.arange(run.T))
    turn = lie.from_parts(lie.exp_so3(np.array([0, 0, np.deg2rad(2)])), np.zeros(3))
    every_second = np.where((np.arange(run.T) % 2 == 0)[:, None, None], turn, np.eye(4))
    row = score_poses.score("pan", _candidate(make_cameras(every_second @ still, run.K, np.arange(run.T))), truth)
    assert row["status"] == "degenerate truth: static camera"
    assert row["ate"] is None
    assert row["rpe_trans"] is None
    assert row["rpe_rot_deg"] == pytest.approx(2, rel=1e-6)


def test_an_estimate_that_does_not_move_has_failed() -> None:
    truth = make_cameras(run.CAM_FROM_WORLD, run.K, np.arange(run.T))
    still = make_cameras(np.tile(np.eye(4), (run.T, 1, 1)), run.K, np.arange(run.T))
    row = score_poses.score("wall", _candidate(still), truth)
    assert row["status"] == "failed"
    assert "no alignment" in row["note"]


def test_the_change_of_a_focal_length_is_shown_as_the_largest_over_the_smallest(tmp_path: Path) -> None:
    (tmp_path / "ba").mkdir()
    cameras = make_cameras(run.CAM_FROM_WORLD, run.K, np.arange(run.T))
    write_cameras(tmp_path / "ba/poses.parquet", cameras, {"zoom": {"change": float(np.log(1.3))}})
    label, unit, _ = pose_statistics.STATISTICS["zoom_change_percent"]
    rows = {row["statistic"]: row for row in pose_statistics.statistic_rows(tmp_path)}
    assert rows[label]["value"] == pytest.approx(30.0)
    assert unit == "%, largest over smallest"


def test_the_decision_about_the_shutter_is_shown_with_its_numbers(tmp_path: Path) -> None:
    (tmp_path / "ba").mkdir()
    cameras = make_cameras(run.CAM_FROM_WORLD, run.K, np.arange(run.T))
    write_cameras(tmp_path / "ba/poses.parquet", cameras, run.DECIDED)
    assert pose_diagnostics.decisions(run.DECIDED)["shutter"] == "rolling"
    rows = {row["statistic"]: row["value"] for row in pose_statistics.statistic_rows(tmp_path)}
    assert rows[pose_statistics.STATISTICS["shutter_readout_percent"][0]] == pytest.approx(70.0)
    assert rows[pose_statistics.STATISTICS["shutter_gain_percent"][0]] == pytest.approx(30.0)


@pytest.mark.parametrize(
    ("statistics", "words"),
    [
        ({}, None),
        ({"loops": 7, "loops_left_out": 0}, "7 joined"),
        ({"loops": 7, "loops_left_out": 2}, "7 joined, 2 left out"),
    ],
)
def test_loops_are_counted_among_the_decisions(statistics: dict[str, int], words: str | None) -> None:
    assert pose_diagnostics.decisions(run.DECIDED | {"statistics": statistics})["loops"] == words


def test_the_focal_curve_is_scored_where_the_true_one_changes() -> None:
    zoom = np.linspace(1, 1.2, run.T)[:, None, None] * [[1, 0, 0], [0, 1, 0], [0, 0, 0]] + np.diag([0, 0, 1])
    truth = make_cameras(run.CAM_FROM_WORLD, run.K @ zoom, np.arange(run.T))
    found = make_cameras(run.CAM_FROM_WORLD, run.K, np.arange(run.T))
    row = score_poses.score("wall", _candidate(found), truth)
    assert row["focal_curve_max_percent"] == pytest.approx(100 * (1 - 1 / 1.2))
    assert row["focal_curve_mean_percent"] == pytest.approx(-row["focal_error_percent"])
    row = score_poses.score("wall", _candidate(found), found)
    assert (row["focal_curve_mean_percent"], row["focal_curve_max_percent"]) == (None, None)


def test_no_poses_and_no_truth_are_rows() -> None:
    failed = score_poses.score("wall", _candidate(None, "no model"), None)
    assert (failed["status"], failed["note"], failed["registered"]) == ("failed", "no model", 0)
    unknown = score_poses.score("wall", _candidate(make_cameras(run.CAM_FROM_WORLD, run.K, np.arange(run.T))), None)
    assert (unknown["status"], unknown["ate"], unknown["registered"]) == ("no truth", None, run.T)


@pytest.fixture(scope="module")
def scored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run.finish(tmp_path_factory.mktemp("scored"), truth=True)


def _row(rows: list[dict], **wanted: object) -> dict:
    return next(row for row in rows if all(row[key] == value for key, value in wanted.items()))


def test_evaluation_of_perfect_poses_finds_no_error(scored: Path) -> None:
    rows = read_rows(scored / "eval/poses.parquet")
    ours = _row(rows, method="ours")
    assert ours["status"] == "ok"
    assert (ours["registered"], ours["total"]) == (run.T, run.T)
    assert max(ours["ate"], ours["rpe_trans"], abs(ours["focal_error_percent"])) < 1e-9
    assert ours["wall_s"] == pytest.approx(2.0 * 8)  # flow, lens, and two rounds of three stages
    assert _row(rows, method="ours, round 1")["wall_s"] == pytest.approx(2.0 * 5)


def test_partial_and_failed_baselines_stay_in_the_table(scored: Path) -> None:
    rows = read_rows(scored / "eval/poses.parquet")
    partial = _row(rows, method="COLMAP global")
    assert (partial["status"], partial["registered"], partial["total"]) == ("partial", 4, run.T)
    assert partial["focal_error_percent"] == pytest.approx(10)
    failed = _row(rows, method="COLMAP incremental")
    assert (failed["status"], failed["note"], failed["ate"]) == ("failed", "reconstruct: no model", None)


def test_evaluation_of_images_masks_and_geometry(scored: Path) -> None:
    images = read_rows(scored / "eval/images.parquet")
    assert {(row["split"], row["region"]) for row in images if row["method"] == "ours"} == {
        *((split, region) for split in ("train", "test") for region in ("whole", "static", "dynamic")),
        ("right", "whole"),
    }
    assert _row(images, split="right", region="whole")["psnr_db"] == pytest.approx(58.92, abs=0.01)
    assert _row(images, split="train", region="whole")["frames"] == run.T - 1
    copied = _row(images, method="nearest training frame", region="whole")
    assert copied["psnr_db"] < _row(images, method="ours", split="test", region="whole")["psnr_db"]
    masks = read_rows(scored / "eval/masks.parquet")
    assert _row(masks, method="refined masks", round=2)["iou"] == 1
    assert 0.5 < _row(masks, method="motion prior", round=2)["iou"] < 1
    shares = [
        run.moving(points, k).sum() / run.movers(points, k).sum() for k in range(run.T) for points, _ in [run.wall(k)]
    ]
    assert 0.2 < np.mean(shares) < 0.9
    assert _row(masks, method="refined masks", round=2)["mover_iou"] == pytest.approx(np.mean(shares))
    checks = read_rows(scored / "eval/checks.parquet")
    assert _row(checks, quantity="flow residual, 90th percentile")["value"] < 0.2  # half a pixel of nearest sampling
    assert _row(checks, quantity="flow end-point error")["value"] < 1e-2
    assert _row(checks, quantity="depth error (AbsRel)")["value"] < 1


def test_checks_say_how_well_motion_is_fitted_and_what_the_model_takes(scored: Path) -> None:
    checks = read_rows(scored / "eval/checks.parquet")
    values = {row["quantity"]: row["value"] for row in checks}
    assert (values[score_models.MEDIAN], values[score_models.P90], values[score_models.STUCK]) == (0.2, 0.7, 0)
    assert (_row(checks, quantity="control points")["value"], _row(checks, quantity="control points")["n"]) == (100, 1)
    assert values["PSNR lost by half precision"] == 0.02
    full, half = ((scored / f"gaussians/{name}.safetensors").stat().st_size for name in ("model", "model_half"))
    assert (values["model file"], values["model file, half precision"]) == (full / 1e6, half / 1e6)
    computed = values["computed: model file with a motion per Gaussian and frame"]
    assert 1e6 * computed == pytest.approx(full - 5 * 100 * 7 * 4 + 50 * run.T * 7 * 4)


def test_a_motion_per_gaussian_is_only_counted_while_it_can_be_seen(scored: Path, tmp_path: Path) -> None:
    """Gaussians of opacity 0.5 are seen up to 3.1 spans from their birth, here in the middle of eight frames."""
    source = scored / "gaussians/model.safetensors"
    tensors, about, half = read_model(source), read_metadata(source), scored / "gaussians/model_half.safetensors"
    tensors["logits"] = np.zeros(1000, np.float32)
    sizes = {}
    for name, span in (("brief", 0.1), ("long", 10.0)):
        spans = {"births": np.full(50, 3 / 7, np.float32), "log_spans": np.full(50, np.log(span), np.float32)}
        path = tmp_path / f"{name}.safetensors"
        write_model(path, tensors | spans, about)
        rows = score_models.model_rows(name, run.T, scored / "control/deformation.safetensors", path, half)
        sizes[name] = 1e6 * rows[-1]["value"] - path.stat().st_size
    assert sizes["long"] - sizes["brief"] == pytest.approx(50 * (run.T - 5) * 7 * 4)


def test_a_frame_without_matches_has_a_pose_in_no_table(scored: Path, tmp_path: Path) -> None:
    status = np.full(run.T, "estimated", object)
    status[2] = "unobserved"
    cameras = replace(read_cameras(scored / "ba/poses.parquet"), status=status)
    write_cameras(tmp_path / "poses.parquet", cameras)
    (candidate,) = score_poses.own_candidates([tmp_path / "poses.parquet"], [(1.0, 1.0, 1)], RunInputs("refined masks"))
    sequence, flow = read_sequence(scored / "sequence.json"), read_dense(scored / "flow/pairs.arrow")
    depth, masks = read_dense(scored / "ba/depth.arrow"), read_masks(scored / "masks", sequence)
    checks = score_geometry.score_geometry(sequence, flow, cameras, depth, run.STRIDE, masks)
    assert candidate.cameras is not None
    assert len(candidate.cameras.numbers) == _row(checks, quantity="frames with a pose")["value"] == run.T - 1


def test_a_round_without_masks_says_so(scored: Path) -> None:
    tables = [scored / "round1/ba/poses.parquet", scored / "ba/poses.parquet"]
    inputs = read_run_inputs(scored / "flow/pairs.arrow", [scored / "masks"], tables)
    first, last = score_poses.own_candidates(tables, [(1.0, 1.0, 1)] * 2, inputs)
    assert first.protocol == "not estimated: nothing; no masks; after round 1 of 2"
    assert last.protocol == "not estimated: nothing; refined masks; after round 2 of 2"


def test_a_stuck_fit_is_a_problem_and_a_still_scene_has_none(scored: Path, tmp_path: Path) -> None:
    models = [scored / "gaussians/model.safetensors", scored / "gaussians/model_half.safetensors"]
    fit = {"status": "stuck", "median_px": 1.25, "p90_px": 9.0, "control_points": 64, "tracks": 10, "attempts": 3}
    for name, metadata in (("stuck", fit), ("still", {"status": "the scene has no moving parts"})):
        write_model(tmp_path / f"{name}.safetensors", {}, metadata)
    stuck, still = (
        score_models.model_rows(name, run.T, tmp_path / f"{name}.safetensors", *models) for name in ("stuck", "still")
    )
    assert not any("motion fit" in row["quantity"] for row in still)
    rows: dict[str, list] = {"poses": [], "checks": [*still, *stuck]}
    (problem,) = overview.problems(rows, [])
    assert problem.startswith("stuck: the fit of the control points is stuck after 3 attempts (residual 1.25 px")


def test_time_rows_follow_the_order_of_the_stages(scored: Path) -> None:
    rows = read_rows(scored / "eval/time.parquet")
    assert [(row["stage"], row["round"]) for row in rows][:6] == [
        *(("inspect", None), ("flow", None), ("lens", None), ("motion", 1), ("segment", 1), ("ba", 1))
    ]
    assert rows[-1]["stage"] == "colmap"


def test_time_rows_of_a_first_round_without_masks_belong_to_the_last(scored: Path) -> None:
    files = [scored / "stats/motion.json", scored / "stats/ba.json", scored / "stats/ba.json"]
    rows = costs.time_rows("run", files)
    assert [(row["stage"], row["round"]) for row in rows] == [("ba", 1), ("motion", 2), ("ba", 2)]


def test_without_truth_the_tables_say_what_is_missing(tmp_path: Path) -> None:
    folder = run.finish(tmp_path, truth=False)
    poses = read_rows(folder / "eval/poses.parquet")
    assert _row(poses, method="ours")["status"] == "no truth"
    assert all(row["iou"] is None and row["mover_iou"] is None for row in read_rows(folder / "eval/masks.parquet"))
    sources = {row["mask_source"] for row in read_rows(folder / "eval/images.parquet")}
    assert sources == {None, "our own masks (refined masks)"}
    quantities = {row["quantity"] for row in read_rows(folder / "eval/checks.parquet")}
    assert "flow residual, median" in quantities
    assert not any("depth" in quantity for quantity in quantities)
    methods = {row["method"] for row in read_rows(folder / "eval/trajectory.parquet")}
    assert methods == {"ours", "ours, round 1", "COLMAP global"}


def test_the_picture_of_the_paths_shows_each_of_them_also_where_they_agree() -> None:
    walk = np.column_stack([np.arange(9.0), np.zeros(9), np.arange(9.0) ** 2])
    near = walk + np.array([0, 0, 0.1])
    picture = draw_paths({"truth": walk, "ours": near, "COLMAP": near}).astype(int)
    legend = len(picture) - 60
    for red, green, blue in ((0xC8, 0xC8, 0xC8), (0xC2, 0x41, 0x0C), (0x25, 0x63, 0xEB)):
        drawn = np.abs(picture[:legend] - [red, green, blue]).max(axis=2) < 40
        halves = drawn[:, : picture.shape[1] // 2].sum(), drawn[:, picture.shape[1] // 2 :].sum()
        assert min(halves) > 50, (red, green, blue)
    assert draw_paths({}).std() > 0
