"""Means over sequences and the figures of the overview."""

from collections.abc import Sequence

import numpy as np

from stages.eval.tables import Column, Row, Table

POSE_METRICS = (
    Column("ate", "ATE", "scene units", 4),
    Column("ate_percent", "ATE", "% of path", 2),
    Column("rpe_trans", "RPE", "scene units", 4),
    Column("rpe_rot_deg", "RPE", "degrees", 3),
    Column("focal_error_percent", "focal error", "%", 1),
    Column("wall_s", "time", "s", 1),
)
IMAGE_METRICS = (Column("psnr_db", "PSNR", "dB", 2), Column("ssim", "SSIM", "0..1", 3))
MASK_METRICS = (
    Column("iou", "IoU", "0..1", 3),
    Column("boundary_f", "boundary F", "0..1", 3),
    Column("dynamic_percent", "called dynamic", "% of pixels", 1),
    Column("true_percent", "truly dynamic", "% of pixels", 1),
)
COSTS = (
    Column("wall_s", "wall time", "s", 1, bar=True),
    Column("cpu_s", "CPU time", "s", 1, bar=True),
    Column("peak_mb", "peak memory", "MB", 0, bar=True),
    Column("gpu_peak_mb", "GPU memory", "MB", 0),
    Column("output_mb", "output", "MB", 2),
)


def mean_rows(rows: Sequence[Row], keys: Sequence[str], metrics: Sequence[Column]) -> list[Row]:
    """One row per distinct `keys`: unweighted means over sequences of what is known, and over how many.

    Rows with a status other than "ok" (failed, partial, degenerate or missing truth) enter no mean of errors: they
    are counted, never dropped.
    """
    groups: dict[tuple, list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    found = []
    for group, members in groups.items():
        good = [row for row in members if row.get("status", "ok") == "ok"]
        mean: Row = dict(zip(keys, group, strict=True)) | {"n": len(good), "sequences": len(members)}
        for metric in metrics:
            values = [row[metric.key] for row in good if row[metric.key] is not None]
            mean[metric.key] = float(np.mean(values)) if values else None
        mean["failed"] = sum(str(row.get("status")) == "failed" for row in members)
        mean["partial"] = sum(str(row.get("status")) == "partial" for row in members)
        found.append(mean)
    return found


def pose_tables(rows: list[Row], protocol: str) -> list[Table]:
    """Means per method, then every sequence."""
    means = mean_rows(rows, ("method",), POSE_METRICS)
    counts = (
        Column("n", "scored"),
        Column("sequences", "of"),
        Column("partial", "partial"),
        Column("failed", "failed"),
    )
    note = (
        f"{protocol}. Unweighted mean over the scored sequences; partial: some frames without a pose, not in the mean."
    )
    frames = Column("registered", "registered", "frames"), Column("total", "of", "frames")
    return [
        Table(
            "poses_mean",
            "Poses, mean over sequences",
            note,
            (Column("method", "method"), *POSE_METRICS, *counts),
            means,
        ),
        Table(
            "poses",
            "Poses of every sequence",
            f"{protocol}. Time: ours from flow to adjustment; COLMAP's features, matching and mapping.",
            (
                *(Column("sequence", "sequence"), Column("method", "method"), *POSE_METRICS, *frames),
                *(Column("status", "status"), Column("note", "note", long=True), Column("protocol", "how", long=True)),
            ),
            rows,
        ),
    ]


def image_tables(rows: list[Row], protocol: str) -> list[Table]:
    """Means per split and region, then every sequence."""
    what = Column("split", "split"), Column("region", "pixels"), Column("method", "method")
    means = mean_rows(rows, [column.key for column in what], IMAGE_METRICS)
    note = f"{protocol}. LPIPS: n/a (no weights)."
    size = Column("width", "width", "px"), Column("height", "height", "px"), Column("protocol", "what", long=True)
    return [
        Table(
            "images_mean", "Images, mean over sequences", note, (*what, *IMAGE_METRICS, Column("n", "sequences")), means
        ),
        Table(
            "images",
            "Images of every sequence",
            note,
            (Column("sequence", "sequence"), *what, *IMAGE_METRICS, Column("frames", "n", "frames"), *size),
            rows,
        ),
    ]


def mask_tables(rows: list[Row], protocol: str) -> list[Table]:
    """Means per round and method, then every sequence."""
    what = Column("method", "method"), Column("round", "round")
    means = mean_rows([row for row in rows if row["iou"] is not None], ("method", "round"), MASK_METRICS)
    return [
        Table(
            "masks_mean",
            "Masks, mean over sequences",
            protocol,
            (*what, *MASK_METRICS, Column("n", "sequences")),
            means,
        ),
        Table(
            "masks",
            "Masks of every sequence",
            protocol,
            (
                *(Column("sequence", "sequence"), *what, *MASK_METRICS),
                *(Column("frames", "n", "frames"), Column("protocol", "what", long=True)),
            ),
            rows,
        ),
    ]


def time_tables(rows: list[Row]) -> list[Table]:
    """Mean cost of every stage, then every sequence."""
    note = "Whole process of each stage, imports included; peak memory is the resident set. Rounds are repetitions."
    what = Column("stage", "stage"), Column("round", "round")
    means = mean_rows(rows, ("stage", "round"), COSTS)
    every = (Column("sequence", "sequence"), *what, *COSTS)
    return [
        Table(
            "time_mean",
            "Cost of every stage, mean over sequences",
            note,
            (*what, *COSTS, Column("n", "sequences")),
            means,
        ),
        Table("time", "Cost of every stage and sequence", note, every, rows),
    ]


def check_table(rows: list[Row]) -> Table:
    """What can be said without truth, and flow and depth where there is truth."""
    columns = (
        *(Column("sequence", "sequence"), Column("quantity", "quantity"), Column("value", "value", "", 3)),
        *(Column("unit", "unit"), Column("n", "n"), Column("protocol", "what", long=True)),
    )
    return Table(
        "checks", "Flow, depth and checks without truth", "Each quantity with its unit, n and protocol.", columns, rows
    )


def decision_table(rows: list[Row]) -> Table:
    """Which effects the reconstruction models, and on what evidence."""
    columns = (
        *(Column("sequence", "sequence"), Column("effect", "effect"), Column("modelled", "modelled")),
        *(Column("why", "why", long=True), Column("source", "decided by"), Column("settings", "settings", long=True)),
        Column("evidence", "evidence", long=True),
    )
    note = (
        "An effect that the evidence does not call for is not modelled; `user` marks a decision overruled by an option."
    )
    return Table("decisions", "Effects the reconstruction models", note, columns, rows)


def simulation_table(rows: list[Row]) -> Table:
    """Which effects the simulator drew, and what each cost."""
    columns = (
        *(Column("sequence", "sequence"), Column("effect", "effect"), Column("simulated", "simulated")),
        *(Column("seconds", "time", "s", 3), Column("calls", "calls"), Column("settings", "settings", long=True)),
    )
    note = "An effect that the scene does not list is not run: its time is 0 and no pixel changes."
    return Table("simulation", "Effects the simulator drew", note, columns, rows)
