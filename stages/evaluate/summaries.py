"""Unweighted means over sequences, with how many were scored and how many failed."""

from collections.abc import Sequence

import numpy as np

from stages.evaluate.costs import is_ours
from stages.shared.tables import Row


def mean_rows(rows: Sequence[Row], keys: Sequence[str], metrics: Sequence[str]) -> list[Row]:
    """One row per distinct `keys`: means of the `metrics` that are known, the most `threads`, and `n`,
    `sequences`, `partial`, `failed`.

    Rows with a status other than "ok" (failed, partial, degenerate or missing truth) are counted but not part of the
    mean errors.
    """
    groups: dict[tuple, list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return [dict(zip(keys, group, strict=True)) | _mean(members, metrics) for group, members in groups.items()]


def _mean(members: Sequence[Row], metrics: Sequence[str]) -> Row:
    good = [row for row in members if row.get("status", "ok") == "ok"]
    counts = {status: sum(row.get("status") == status for row in members) for status in ("partial", "failed")}
    known = {key: [row[key] for row in good if row[key] is not None] for key in metrics}
    means = {key: float(np.mean(values)) if values else None for key, values in known.items()}
    threads = max((row["threads"] for row in members if row.get("threads") is not None), default=None)
    return means | {"threads": threads, "n": len(good), "sequences": len(members)} | counts


def pose_means(rows: Sequence[Row]) -> list[Row]:
    """Means per method and inputs from ground truth; of focal errors the absolute ones: signs would cancel."""
    signed = "focal_error_percent"
    sized = [row | {"focal_abs_percent": None if row[signed] is None else abs(row[signed])} for row in rows]
    metrics = ("ate", "ate_percent", "rpe_trans", "rpe_rot_deg", "focal_abs_percent", "wall_s", "cpu_s")
    return mean_rows(sized, ("method", "taken"), metrics)


def image_means(rows: Sequence[Row]) -> list[Row]:
    """Means per split, region and method."""
    return mean_rows(rows, ("split", "region", "method"), ("psnr_db", "ssim", "lpips"))


def mask_means(rows: Sequence[Row]) -> list[Row]:
    """Means per method and round over the sequences with true masks."""
    scored = [row for row in rows if row["iou"] is not None]
    scores = ("iou", "mover_iou", "boundary_f", "precision", "recall", "dynamic_percent", "true_percent")
    return mean_rows(scored, ("method", "round"), scores)


def time_means(rows: Sequence[Row]) -> list[Row]:
    """Mean cost of every stage and, last, the total of our stages: sums of seconds, the largest peak of memory."""
    keys = ("wall_s", "cpu_s", "peak_mb", "gpu_peak_mb", "output_mb")
    means = mean_rows(rows, ("stage", "round"), keys)
    ours = [row for row in means if is_ours(row)]
    total: Row = {"stage": "total without COLMAP", "round": None, "n": max((row["n"] for row in ours), default=0)}
    total["is_total"] = True
    for key in ("threads", *keys):
        values = [row[key] for row in ours if row[key] is not None]
        combine = max if key == "threads" or key.endswith("peak_mb") else sum
        total[key] = combine(values) if values else None
    return [*means, total]
