"""Accuracy against cost: means of the sweep's settings, the Pareto front, and the cost of 10 % less error."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stages.shared.tables import Row, decimal

POSE_METRICS = ("ate_percent", "rpe_rot_deg", "focal_abs_percent")
OTHER_METRICS = (
    *("iou", "boundary_f", "psnr_db", "psnr_static_db", "psnr_dynamic_db", "ssim"),
    *("wall_s", "cpu_s", "poses_wall_s", "poses_cpu_s", "peak_mb", "model_mb"),
    *("step_ms", "equal_psnr_db", "equal_s", "configured_equal_s"),
)
NOTICED = 0.01
"""Smaller relative differences count as noise."""
KEYS = ("group", "setting", "knob", "value", "is_default")


def means(rows: Sequence[Row]) -> list[Row]:
    """One row per setting of a group: unweighted means over its sequences, and counts.

    `n` counts the sequences with scored poses, `sequences` all of them, `failed` those with failed or partial poses.
    Poses that failed, are partial or lack ground truth are excluded from the means of pose errors.
    """
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in KEYS), []).append(row)
    return [dict(zip(KEYS, keys, strict=True)) | _mean(members) for keys, members in groups.items()]


def _mean(members: Sequence[Row]) -> Row:
    scored = [with_size(row) for row in members if row["status"] == "ok"]
    found = {key: _known_mean(scored, key) for key in POSE_METRICS}
    found |= {key: _known_mean(members, key) for key in OTHER_METRICS}
    failed = sum(row["status"] in ("failed", "partial") for row in members)
    return {**found, "n": len(scored), "sequences": len(members), "failed": failed}


def with_size(row: Row) -> Row:
    """The row with the absolute value of its focal error, since signed errors would cancel in means."""
    signed = row["focal_error_percent"]
    return row | {"focal_abs_percent": None if signed is None else abs(signed)}


def _known_mean(rows: Sequence[Row], key: str) -> float | None:
    values = [row[key] for row in rows if row[key] is not None]
    return float(np.mean(values)) if values else None


@dataclass(frozen=True)
class Point:
    """A setting in the plane of seconds and error.

    Attributes:
        seconds, error: means over the sequences; a smaller error is better.
        name: of the setting or of COLMAP's variant. label: of the point in the chart.
        complete: scored on every sequence; incomplete points are drawn hollow and never count as better.
        is_default: whether this is the configured run.
    """

    seconds: float
    error: float
    name: str
    label: str
    complete: bool = True
    is_default: bool = False


def pareto_front(points: Sequence[Point]) -> list[Point]:
    """The complete points that no other complete point beats in both seconds and error, by increasing seconds."""
    front: list[Point] = []
    for point in sorted((p for p in points if p.complete), key=lambda p: (p.seconds, p.error)):
        if not front or point.error < front[-1].error:
            front.append(point)
    return front


def next_tenth(points: Sequence[Point], what: str) -> str:
    """A sentence on the cost of reducing the error of the configured run by a tenth, from measured settings alone.

    If the next better setting reduces the error by several tenths, its cost is divided by their number.

    Args:
        points: our own settings, including the configured one.
        what: name of the error, with its unit, as in "camera error (% of path)".
    """
    front = pareto_front(points)
    start = next((p for p in points if p.is_default and p.complete), None)
    if start is None:
        return f"{what}: not known on every sequence for the configured run, so no cost of a smaller error is given."
    here = f"{decimal(start.error, 2)} in {start.seconds:.0f} s"
    if front[-1].error > (1 - NOTICED) * start.error:
        return f"{what}: no measured setting is more than 1 % better than the configured one ({here})."
    better = [p for p in front if p.error <= 0.9 * start.error]
    if not better:
        best = front[-1]
        return (
            f"{what}: no measured setting is a tenth better than the configured one ({here}); "
            f"the best, {best.name}, gives {decimal(best.error, 2)} in {best.seconds:.0f} s."
        )
    step = better[0]
    gain, price = 1 - step.error / start.error, step.seconds - start.seconds
    reached = f"{step.name} gives {decimal(step.error, 2)} in {step.seconds:.0f} s, {100 * gain:.0f} % less"
    if price <= 0:
        return f"{what}: from the configured run ({here}) the next tenth costs no time: {reached}."
    each = decimal(price * np.log(0.9) / np.log(1 - gain), 1)
    return f"{what}: from the configured run ({here}) the next tenth costs {each} s: {reached} for {price:.0f} s more."
