"""Collect the scores and costs of every setting of a sweep into one table."""

import json
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

from stages.comparisons import made_under
from stages.comparisons.training_speed import compare_training
from stages.configuration.settings import is_baseline
from stages.evaluate.costs import is_ours
from stages.evaluate.score_masks import PRIOR
from stages.shared import cli
from stages.shared.artifacts import read_json, read_table
from stages.shared.cli import In, Out
from stages.shared.tables import Row, read_rows, write_rows

POSE_SCORES = (
    *("ate", "ate_percent", "rpe_trans", "rpe_rot_deg", "focal_error_percent", "path"),
    *("registered", "total", "status", "note", "camera", "focal", "focal_sigma_percent", "warnings"),
    *("threads", "taken"),
)
COLUMNS = (
    *("sequence", "group", "setting", "knob", "value", "is_default", "overrides", "effects"),
    *(*POSE_SCORES, "iou", "boundary_f"),
    *("psnr_db", "psnr_static_db", "psnr_dynamic_db", "ssim"),
    *("wall_s", "cpu_s", "differing_cpu_s", "poses_wall_s", "poses_cpu_s", "peak_mb", "model_mb"),
    *("step_ms", "equal_psnr_db", "equal_s", "configured_equal_s"),
)
POSE_STAGES = ("flow", "lens", "motion", "segment", "ba")
PROTOCOL = (
    "Seconds are those of all stages from the frames to the renders. Shared stages are counted in full, as in a run "
    "from scratch; COLMAP and evaluation are left out. Poses: flow to adjustment, all rounds. "
    "differing_cpu_s: without the stages that all settings of the group share. "
    "equal_s and configured_equal_s: seconds of training to the PSNR of training frames that both runs reach."
)


def main(
    runs: Annotated[Path, In("runs.json: sequence, setting, and paths of scores relative to the dataset's folder")],
    output: Annotated[Path, Out("costs.parquet: a row per sequence and setting")],
) -> None:
    """Write one row per sequence and setting, and one per variant of COLMAP; unknown scores are null.

    The metadata hold options, code and frames of the configured run.
    """
    folder = runs.parents[1]
    listed = read_json(runs)["runs"]
    rows = [
        row
        for run in listed
        for row in (baseline_rows(folder, run) if is_baseline(run["overrides"]) else [run_row(folder, run)])
    ]
    units = {"ate_percent": "% of path", "focal_error_percent": "%", "peak_mb": "MB", "model_mb": "MB", "wall_s": "s"}
    about = {"protocol": PROTOCOL, "units": units, "made_under": made_under.of_runs(folder, listed)}
    write_rows(output, rows, COLUMNS, about)


def run_row(folder: Path, run: Row) -> Row:
    """The row of one run.

    Args:
        folder: of the dataset's results; paths in `run` are relative to it.
        run: sequence, group, setting, knob, value, is_default, overrides, scores (a folder), scene and model (files),
            shared (the stages that are the same in its whole group), and convergence and configured_convergence, the
            training histories of this run and of the configured one.
    """
    scores = folder / run["scores"]
    named = {name: run[name] for name in ("sequence", "group", "setting", "knob", "is_default")}
    value = None if run["value"] is None else _text(run["value"])
    model_mb = (folder / run["model"]).stat().st_size / 1e6
    trainings = (read_table(folder / run[name]) for name in ("convergence", "configured_convergence"))
    return {
        **named,
        "value": value,
        "overrides": json.dumps(run["overrides"]),
        "effects": effects_in_words(read_json(folder / run["scene"])),
        **pose_scores(read_rows(scores / "poses.parquet")),
        **mask_scores(read_rows(scores / "masks.parquet")),
        **image_scores(read_rows(scores / "images.parquet")),
        **costs(read_rows(scores / "time.parquet"), run["shared"]),
        "model_mb": model_mb,
        **compare_training(*trainings),
    }


def baseline_rows(folder: Path, run: Row) -> list[Row]:
    """A row per variant of COLMAP in a run that varies COLMAP, named by its method; arguments as in `run_row`."""
    about = {name: run[name] for name in ("sequence", "group", "knob", "is_default")}
    about |= {"overrides": json.dumps(run["overrides"])}
    unknown = dict.fromkeys(COLUMNS)
    return [
        unknown
        | about
        | {name: row[name] for name in POSE_SCORES}
        | {"setting": row["method"], "poses_wall_s": row["wall_s"], "poses_cpu_s": row["cpu_s"]}
        for row in read_rows(folder / run["scores"] / "poses.parquet")
        if str(row["method"]).startswith("COLMAP")
    ]


def pose_scores(rows: Iterable[Row]) -> Row:
    """Errors of our poses after the last round."""
    ours = next(row for row in rows if row["method"] == "ours")
    return {name: ours[name] for name in POSE_SCORES}


def mask_scores(rows: Iterable[Row]) -> Row:
    """IoU and boundary F of the masks of the last round; None without truth."""
    used = [row for row in rows if row["method"] != PRIOR]
    last = max(used, key=lambda row: row["round"], default={})
    return {name: last.get(name) for name in ("iou", "boundary_f")}


def image_scores(rows: Iterable[Row]) -> Row:
    """PSNR and SSIM on held-out frames; None for a region without pixels."""
    found = {row["region"]: row for row in rows if row["method"] == "ours" and row["split"] == "test"}
    psnr = {region: found[region]["psnr_db"] if region in found else None for region in ("whole", "static", "dynamic")}
    return {
        "psnr_db": psnr["whole"],
        "psnr_static_db": psnr["static"],
        "psnr_dynamic_db": psnr["dynamic"],
        "ssim": found["whole"]["ssim"] if "whole" in found else None,
    }


def effects_in_words(decisions: Mapping[str, Any]) -> str:
    """The effects that a run models, from scene.json: of fog only what was measured, since there may be none.

    A camera that only turns is not listed: that is a finding, no model.
    """
    modelled = [
        name
        for name, found in decisions.items()
        if isinstance(found, dict) and found["needed"] and found.get("extinction", 1.0) > 0 and name != "rotation_only"
    ]
    return ", ".join(name.replace("_", " ") for name in modelled)


def costs(rows: Iterable[Row], shared: Collection[str] = ()) -> Row:
    """Seconds of all stages, of those not `shared` by the group, of those up to the poses; the largest peak memory."""
    counted = [row for row in rows if is_ours(row)]
    to_poses = [row for row in counted if row["stage"] in POSE_STAGES]
    return {
        "wall_s": sum(row["wall_s"] for row in counted),
        "cpu_s": sum(row["cpu_s"] for row in counted),
        "differing_cpu_s": sum(row["cpu_s"] for row in counted if row["stage"] not in shared),
        "poses_wall_s": sum(row["wall_s"] for row in to_poses),
        "poses_cpu_s": sum(row["cpu_s"] for row in to_poses),
        "peak_mb": max(row["peak_mb"] for row in counted),
    }


def _text(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)


if __name__ == "__main__":
    cli.run(main)
