"""Score one sequence: poses, images, masks, depth and flow against whatever truth there is, and what it cost."""

import re
from collections.abc import Sequence as Rows
from pathlib import Path
from typing import Annotated

from stages.eval import image_metrics, mask_metrics, score_geometry, score_images, score_masks, score_poses, trajectory
from stages.eval.options import EvaluateOptions
from stages.eval.paths import path_rows
from stages.eval.plots import draw_trajectories
from stages.eval.tables import Row, write_rows
from stages.eval.truth import true_cameras, true_masks
from stages.shared import cli
from stages.shared.artifacts import atomic, read_dense, read_json, read_metadata
from stages.shared.cameras import read_cameras
from stages.shared.cli import In, Out
from stages.shared.log import logger
from stages.shared.sequences import read_sequence

POSES = (
    *("sequence", "method", "registered", "total", "ate", "ate_percent", "rpe_trans", "rpe_rot_deg"),
    *("focal_error_percent", "path", "wall_s", "cpu_s", "status", "note", "protocol"),
)
IMAGES = (
    *(
        "sequence",
        "method",
        "split",
        "region",
        "psnr_db",
        "ssim",
        "frames",
        "width",
        "height",
        "mask_source",
        "protocol",
    ),
)
MASKS = (
    *("sequence", "method", "round", "iou", "boundary_f", "dynamic_percent", "true_percent", "frames", "protocol"),
)
CHECKS = ("sequence", "quantity", "value", "unit", "n", "protocol")
TIME = ("sequence", "stage", "round", "wall_s", "cpu_s", "peak_mb", "gpu_peak_mb", "output_mb")
BEFORE, REPEATED = ("inspect", "flow"), ("motion", "segment", "ba")
AFTER = ("scene", "control", "gaussians", "render", "colmap")
TRAJECTORY = ("method", "frame", "x", "y", "z", "error")
FRAMES = ("kind", "method", "split", "frame", "metric", "value")


def main(
    sequence: Annotated[Path, In("sequence.json of the input check")],
    flow: Annotated[Path, In("optical flow over the edge list")],
    priors: Annotated[list[Path], In("motion priors, one file per round, in order")],
    masks: Annotated[list[Path], In("folders of refined masks, one per round, in order")],
    poses: Annotated[list[Path], In("tables of estimated poses, one per round, in order")],
    depth: Annotated[Path, In("inverse depth of the last round")],
    colmap: Annotated[Path, In("poses of the baseline")],
    renders: Annotated[Path, In("folder of rendered views, a folder per split")],
    stage_stats: Annotated[list[Path], In("seconds and memory of the stages, stats/<stage>.json")],
    poses_table: Annotated[Path, Out("pose errors, a row per method")],
    images_table: Annotated[Path, Out("image scores, a row per method, split and region")],
    masks_table: Annotated[Path, Out("mask scores, a row per round and method")],
    checks_table: Annotated[Path, Out("flow residual, flow and depth errors, a row per quantity")],
    time_table: Annotated[Path, Out("seconds, memory and output size, a row per stage")],
    trajectory_table: Annotated[Path, Out("aligned camera centres, a row per method and frame")],
    frames_table: Annotated[Path, Out("image and mask scores of single frames")],
    figure: Annotated[Path, Out("picture of the trajectories")],
    options: EvaluateOptions,
) -> None:
    """Write one row per method and protocol; what cannot be scored is a row that says why."""
    frames = read_sequence(sequence)
    truth = true_cameras(frames)
    times = sorted((_time_row(frames.name, path, len(poses)) for path in stage_stats), key=_stage_order)
    write_rows(time_table, times, TIME, {"unit": "seconds and MB"})
    seconds = _seconds_to_poses(times, len(poses))
    candidates = [*score_poses.own_candidates(poses, seconds), *score_poses.colmap_candidates(colmap)]
    pose_rows = [score_poses.score(frames.name, candidate, truth) for candidate in candidates]
    _log_rows("poses", pose_rows)
    write_rows(poses_table, pose_rows, POSES, {"protocol": trajectory.PROTOCOL})
    paths = path_rows(candidates, truth)
    write_rows(trajectory_table, paths, TRAJECTORY, {"unit": "scene units of the truth, or of ours without truth"})

    moving, source = true_masks(frames)
    own_masks = [score_masks.read_masks(folder) for folder in masks]
    own_priors = [score_masks.read_prior_masks(path, frames.width, frames.height) for path in priors]
    by_round = [{"motion prior": p, "refined masks": m} for p, m in zip(own_priors, own_masks, strict=True)]
    mask_rows, mask_frames = score_masks.score_masks(frames.name, by_round, moving, source)
    write_rows(masks_table, mask_rows, MASKS, {"protocol": mask_metrics.PROTOCOL})

    regions = (moving, source) if moving else (own_masks[-1], "our own masks")
    image_rows, image_frames = score_images.score_images(frames, renders, *regions, options)
    write_rows(images_table, image_rows, IMAGES, {"protocol": image_metrics.PROTOCOL})
    per_frame = [
        *_long(image_frames, "images", ("psnr_db", "ssim")),
        *_long(mask_frames, "masks", ("iou", "boundary_f")),
    ]
    write_rows(frames_table, per_frame, FRAMES, {})

    stride_px = read_metadata(depth)["stride_px"]
    checks = score_geometry.score_geometry(
        frames, read_dense(flow), read_cameras(poses[-1]), read_dense(depth), stride_px, own_masks[-1]
    )
    _log_rows("checks", checks)
    write_rows(checks_table, checks, CHECKS, {})
    with atomic(figure) as partial:
        partial.write_bytes(draw_trajectories(paths, "png"))


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


def _time_row(name: str, stats: Path, rounds: int) -> Row:
    """What `<folder>/<sequence>/[roundN/]stats/<stage>.json` says; the last round has no folder of its own."""
    content, folder = read_json(stats), stats.parent.parent.name
    number = int(folder.removeprefix("round")) if re.fullmatch(r"round\d+", folder) else rounds
    costs = {name: content[name] for name in ("wall_s", "cpu_s", "peak_mb", "gpu_peak_mb", "output_mb")}
    return {"sequence": name, "stage": stats.stem, "round": number if stats.stem in REPEATED else None} | costs


def _stage_order(row: Row) -> tuple[int, ...]:
    """Stages as they run: before the rounds, each round, after them."""
    stage = row["stage"]
    if stage in REPEATED:
        return 1, row["round"], REPEATED.index(stage)
    before = stage in BEFORE
    return 0 if before else 2, (BEFORE if before else AFTER).index(stage)


def _seconds_to_poses(times: Rows[Row], rounds: int) -> list[tuple[float, float]]:
    """Wall and CPU seconds from the frames to the poses of each round."""
    until = [
        [row for row in times if row["stage"] == "flow" or (row["round"] or rounds + 1) <= k + 1] for k in range(rounds)
    ]
    return [(sum(row["wall_s"] for row in part), sum(row["cpu_s"] for row in part)) for part in until]


if __name__ == "__main__":
    cli.run(main)
