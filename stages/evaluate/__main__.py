"""Score one sequence: poses, images, masks, depth and flow against the available ground truth, and their cost."""

from collections.abc import Mapping
from collections.abc import Sequence as Rows
from pathlib import Path
from typing import Annotated

import numpy as np

from stages.evaluate import (
    costs,
    image_metrics,
    lpips,
    mask_metrics,
    pose_diagnostics,
    score_geometry,
    score_images,
    score_lens,
    score_masks,
    score_models,
    score_poses,
    trajectory,
)
from stages.evaluate.figure import draw_paths
from stages.evaluate.ground_truth import true_cameras, true_masks, true_movers
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.paths import path_rows
from stages.shared import cli
from stages.shared.artifacts import Dense, read_dense, read_json, read_metadata
from stages.shared.cameras import read_cameras
from stages.shared.charts import paths_of
from stages.shared.cli import In, Out
from stages.shared.images import write_figure
from stages.shared.log import logger
from stages.shared.masks import read_masks
from stages.shared.run_inputs import RunInputs, given_in_words, read_run_inputs, taken_inputs
from stages.shared.sequences import Sequence, read_sequence
from stages.shared.tables import Row, read_rows, write_rows

POSES = (
    *("sequence", "method", "registered", "total", "ate", "ate_percent", "rpe_trans", "rpe_rot_deg"),
    *(
        "focal_error_percent",
        *score_poses.FOCAL_CURVE,
        "path",
        "wall_s",
        "cpu_s",
        "threads",
        "status",
        "note",
        "protocol",
        "taken",
    ),
    *pose_diagnostics.DECISIONS,
)
IMAGES = (
    *("sequence", "method", "split", "region", "psnr_db", "ssim", "lpips", "frames", "width", "height"),
    *("mask_source", "protocol", "taken"),
)
MASKS = (
    *("sequence", "method", "round", "iou", "mover_iou", "boundary_f", "precision", "recall"),
    *("dynamic_percent", "true_percent", "frames", "protocol", "taken"),
)
CHECKS = ("sequence", "quantity", "value", "unit", "n", "protocol", "taken")
TIME = ("sequence", "stage", "round", "threads", "wall_s", "cpu_s", "peak_mb", "gpu_peak_mb", "output_mb")
TRAJECTORY = ("method", "frame", "x", "y", "z", "error")
FRAMES = ("kind", "method", "split", "frame", "metric", "value")


def main(
    sequence: Annotated[Path, In("sequence.json of the input check")],
    flow: Annotated[Path, In("optical flow over the edge list")],
    priors: Annotated[list[Path], In("motion priors, one file per round; none if masks are not estimated", True)],
    masks: Annotated[list[Path], In("folders of masks, one per round, in order, or one")],
    poses: Annotated[list[Path], In("tables of estimated poses, one per round, in order")],
    depth: Annotated[Path, In("inverse depth of the last round")],
    colmap: Annotated[list[Path], In("poses of the baseline, without and with our masks")],
    deformation: Annotated[Path, In("control/deformation.safetensors")],
    model: Annotated[Path, In("Gaussians, model.safetensors")],
    half: Annotated[Path, In("the same in half precision")],
    renders: Annotated[Path, In("folder of rendered views, a folder per split")],
    stage_stats: Annotated[list[Path], In("seconds and memory of the stages, stats/<stage>.json, rounds in order")],
    poses_table: Annotated[Path, Out("pose errors, a row per method")],
    images_table: Annotated[Path, Out("image scores, a row per method, split and region")],
    masks_table: Annotated[Path, Out("mask scores, a row per round and method")],
    checks_table: Annotated[Path, Out("flow, depth, motion and file sizes, a row per quantity")],
    time_table: Annotated[Path, Out("seconds, memory and output size, a row per stage")],
    trajectory_table: Annotated[Path, Out("aligned camera centres, a row per method and frame")],
    frames_table: Annotated[Path, Out("image and mask scores of single frames")],
    figure: Annotated[Path, Out("picture of the trajectories")],
    options: EvaluateOptions,
    lens: Annotated[Path | None, In("lens/lens.json")] = None,
) -> str:
    """Write one row per method and protocol; a row that cannot be scored gives the reason."""
    frames = read_sequence(sequence)
    times = costs.time_rows(frames.name, stage_stats)
    write_rows(time_table, times, TIME, {"unit": "seconds and MB"})
    inputs = read_run_inputs(flow, masks, poses)
    own = score_poses.own_candidates(poses, costs.spent_to_poses(times, len(poses)), inputs)
    candidates = [*own, *score_poses.colmap_candidates(*colmap)]
    _write_poses(frames, candidates, poses_table, trajectory_table, figure)
    own_masks = [read_masks(folder, frames) for folder in masks]
    pairs = read_dense(flow)
    mask_frames = _write_masks(frames, (priors, own_masks), inputs, masks_table)
    cameras = read_cameras(poses[-1])
    unobserved = frozenset(cameras.numbers[cameras.status == "unobserved"].tolist())
    image_frames = _write_images(frames, renders, pairs, (own_masks[-1], inputs), unobserved, images_table, options)
    write_rows(frames_table, [*image_frames, *mask_frames], FRAMES, {})
    checks = _score_geometry(frames, pairs, poses[-1], depth, own_masks[-1])
    checks += score_models.model_rows(frames.name, len(frames.frames), deformation, model, half)
    if lens:
        checks += score_lens.lens_rows(frames, read_json(lens), cameras)
    given = given_in_words(frames.name, taken_inputs(flow, masks[-1], poses[-1]))
    _write_checks(checks, inputs, given, checks_table)
    return _result(poses_table, masks_table, images_table)


def _result(poses_table: Path, masks_table: Path, images_table: Path) -> str:
    """The scores of the sequence in a few words; those without ground truth are left out."""
    poses = {row["method"]: row for row in read_rows(poses_table)}
    masks = [row for row in read_rows(masks_table) if row["method"] != score_masks.PRIOR]
    images = [row for row in read_rows(images_table) if (row["split"], row["region"]) == ("test", "whole")]
    figures = {
        "ATE {:.3f} % of path": poses["ours"]["ate_percent"],
        "mask IoU {:.2f}": masks[-1]["iou"] if masks else None,
        "held-out PSNR {:.1f} dB": {row["method"]: row["psnr_db"] for row in images}.get("ours"),
    }
    return ", ".join(words.format(value) for words, value in figures.items() if value is not None)


def _write_poses(
    frames: Sequence, candidates: Rows[score_poses.Candidate], poses_table: Path, trajectory_table: Path, figure: Path
) -> None:
    """Write the errors and paths of every method, and the picture of the paths."""
    truth = true_cameras(frames)
    rows = [score_poses.score(frames.name, candidate, truth) for candidate in candidates]
    _log_rows("poses", rows)
    write_rows(poses_table, rows, POSES, {"protocol": trajectory.PROTOCOL})
    paths = path_rows(candidates, truth)
    write_rows(trajectory_table, paths, TRAJECTORY, {"unit": "scene units of the truth, or of ours without truth"})
    write_figure(figure, draw_paths(paths_of(paths)))


def _write_masks(
    frames: Sequence, by_round: tuple[Rows[Path], Rows[Mapping[int, np.ndarray]]], inputs: RunInputs, table: Path
) -> list[Row]:
    """Write scores of the priors and the masks of every round that has any; returns those of single frames."""
    size = frames.width, frames.height
    priors, own_masks = by_round
    masks: dict[int, dict[str, Mapping[int, np.ndarray]]]
    masks = {k: {inputs.masks: own} for k, own in enumerate(own_masks, inputs.masked_from)}
    for k, prior in enumerate(priors, inputs.masked_from):
        masks[k] = {score_masks.PRIOR: score_masks.read_prior_masks(prior, *size)} | masks[k]
    rows, of_frames = score_masks.score_masks(frames.name, masks, *true_masks(frames), true_movers(frames))
    write_rows(table, _with(inputs.taken, rows), MASKS, {"protocol": mask_metrics.PROTOCOL})
    return _long(of_frames, "masks", ("iou", "boundary_f"))


def _write_images(
    frames: Sequence,
    renders: Path,
    flow: Dense,
    masks: tuple[Mapping[int, np.ndarray], RunInputs],
    unobserved: frozenset[int],
    table: Path,
    options: EvaluateOptions,
) -> list[Row]:
    """Write scores of the renders and of the image baselines; returns those of single frames."""
    moving, source = true_masks(frames)
    own_masks, inputs = masks
    regions = (moving, source) if moving else (own_masks, f"our own masks ({inputs.masks})")
    rows, of_frames = score_images.score_images(frames, renders, flow, regions, options, unobserved)
    write_rows(
        table, _with(inputs.taken, rows), IMAGES, {"protocol": f"{image_metrics.PROTOCOL}. {_lpips_protocol(options)}"}
    )
    return _long(of_frames, "images", ("psnr_db", "ssim"))


def _score_geometry(
    frames: Sequence, flow: Dense, poses: Path, depth: Path, masks: Mapping[int, np.ndarray]
) -> list[Row]:
    """Rows on flow and depth, of the last round."""
    grid = read_dense(depth), read_metadata(depth)["stride_px"]
    return score_geometry.score_geometry(frames, flow, read_cameras(poses), *grid, masks)


def _write_checks(checks: Rows[Row], inputs: RunInputs, given: str, table: Path) -> None:
    """Write what was checked of flow, depth, motion and file sizes; what was `given` for the report, without flow."""
    _log_rows("checks", checks)
    write_rows(table, _with(inputs.taken, checks), CHECKS, {"given": given})


def _with(taken: str | None, rows: Rows[Row]) -> list[Row]:
    """The rows with the column of inputs that were taken instead of estimated."""
    return [row | {"taken": taken} for row in rows]


def _lpips_protocol(options: EvaluateOptions) -> str:
    return lpips.PROTOCOL if options.lpips_weights else "LPIPS: n/a (no weights)"


def _log_rows(name: str, rows: Rows[Row]) -> None:
    for row in rows:
        logger.info("%s: %s", name, {key: value for key, value in row.items() if key != "protocol"})


def _long(rows: Rows[Row], kind: str, metrics: tuple[str, ...]) -> list[Row]:
    """One row per score."""
    return [
        {"kind": kind, "method": row["method"], "split": row.get("split"), "frame": row["frame"]}
        | {"metric": metric, "value": row[metric]}
        for row in rows
        for metric in metrics
    ]


if __name__ == "__main__":
    cli.run(main)
