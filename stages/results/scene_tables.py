"""The tables of the results page: every scene, and medians and means over the scenes of each part."""

from collections.abc import Callable, Sequence

import numpy as np

from stages.evaluate import ratios
from stages.evaluate.score_images import REGIONS
from stages.results.scorecard import OWN
from stages.shared.tables import Column, Row, Table, decimal

PARTS = {
    "test": "Test scenes, which nobody tunes on",
    "tuned": "Tuned scenes, which options and limits were chosen on",
    OWN: "Scenes without a split",
}
SHORT = {"test": "test", "tuned": "tuned", OWN: "no split"}
WRONG_ATE_PERCENT, WRONG_ROTATION_DEG, WRONG_FOCAL_PERCENT = 1.0, 0.1, 10.0
"""A result counts as wrong above these errors: ATE in % of the path, rotation from frame to frame, focal length."""
SCENE = Column("scene", "scene")
CAMERAS = (
    SCENE,
    Column("frames", "frames"),
    Column("camera", "camera"),
    Column("result", "result"),
    Column("error", "camera error"),
    Column("colmap_error", "COLMAP"),
    Column("focal_error_percent", "focal error", "%", 2),
    Column("iou", "mask IoU", "", 2),
    Column("mover_iou", "movers at rest too", "", 2),
    Column("precision", "precision", "", 2),
    Column("recall", "recall", "", 2),
    Column("still", "nothing moves: masked"),
    Column("spent", "to poses: wall / CPU, s"),
    Column("colmap_cpu_s", "COLMAP: CPU", "s", 1),
    Column("flags", "flags"),
)
VIEWS = (
    SCENE,
    Column("psnr", "held-out PSNR: whole / static / moving, dB"),
    Column("warp", "warping neighbours by our flow, dB"),
    Column("gain", "ours minus warping, dB"),
    Column("ssim", "SSIM of movers: ours / warping"),
    Column("right_db", "right eye", "dB", 1),
    Column("wall_s", "all our stages", "s", 0),
    Column("cpu_s", "CPU", "s", 0),
)
FIGURES: tuple[tuple[str, str, int], ...] = (
    ("ate_percent", "camera error (ATE), % of path", 3),
    ("colmap_percent", "the same by COLMAP", 3),
    ("rotation_deg", "rotation error where no ATE is defined, degrees", 3),
    ("focal_abs_percent", "focal error, %", 2),
    ("iou", "mask IoU", 2),
    ("mover_iou", "mask IoU, movers at rest counted too", 2),
    ("precision", "mask precision", 2),
    ("recall", "mask recall", 2),
    ("psnr_whole", "held-out PSNR, whole, dB", 1),
    ("psnr_static", "held-out PSNR, static, dB", 1),
    ("psnr_dynamic", "held-out PSNR, moving, dB", 1),
    ("warp_whole", "warping neighbours by our flow, whole, dB", 1),
    ("warp_static", "warping neighbours, static, dB", 1),
    ("warp_dynamic", "warping neighbours, moving, dB", 1),
    ("gain_whole", "ours minus warping, whole, dB", 1),
    ("gain_static", "ours minus warping, static, dB", 1),
    ("gain_dynamic", "ours minus warping, moving, dB", 1),
    ("ssim_dynamic", "held-out SSIM, moving", 3),
    ("warp_ssim_dynamic", "warping neighbours, SSIM, moving", 3),
    ("right_db", "right-eye PSNR, dB", 1),
    ("wall_s", "all our stages, s", 0),
    ("cpu_s", "all our stages, CPU s", 0),
    ("poses_s", "to poses, s", 1),
    ("poses_cpu_s", "to poses, CPU s", 1),
    ("colmap_cpu_s", "COLMAP to poses, CPU s", 1),
)
HEADLINE = (
    *("ate_percent", "colmap_percent", "focal_abs_percent", "iou", "mover_iou"),
    *("psnr_whole", "psnr_static", "psnr_dynamic"),
    *("warp_whole", "warp_static", "warp_dynamic", "gain_whole", "gain_dynamic"),
    *("cpu_s", "poses_cpu_s", "colmap_cpu_s"),
)
"""The figures in the summary."""


def parts_of(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The rows by split, test scenes first; splits without scenes are left out."""
    splits = [row["split"] if row["split"] in PARTS else OWN for row in rows]
    found = {split: [row for row, of in zip(rows, splits, strict=True) if of == split] for split in PARTS}
    return {split: part for split, part in found.items() if part}


def camera_table(rows: Sequence[Row]) -> Table:
    """Cameras and masks of every scene, failed ones too."""
    shown = []
    for row in rows:
        words = {"scene": row["sequence"], "result": result_of(row), "still": _still(row)}
        shown.append(row | words | {"spent": _spent(row)})
    return Table("cameras", "Cameras and masks", "", CAMERAS, shown)


def view_table(rows: Sequence[Row]) -> Table:
    """Held-out and right-eye views of every scene, failed ones too."""
    shown = []
    for row in rows:
        of = {name: [row.get(f"{name}_{region}") for region in REGIONS] for name in ("psnr", "warp", "gain")}
        ssim = _several([row.get("ssim_dynamic"), row.get("warp_ssim_dynamic")], digits=2)
        regions = {name: _several(values) for name, values in of.items()}
        shown.append(row | {"scene": row["sequence"], "ssim": ssim} | regions)
    return Table("views", "Views that were not used for training", "", VIEWS, shown)


def figure_table(parts: dict[str, list[Row]], keys: Sequence[str] = ()) -> Table:
    """Median, mean and number of scored scenes of every figure (or those in `keys`), with columns for each part."""
    columns, lines = [Column("figure", "figure")], []
    for split in parts:
        name = SHORT[split]
        columns += [Column(f"{split}_{kind}", f"{name}: {kind}") for kind in ("median", "mean", "n")]
    for key, label, digits in FIGURES:
        line: Row = {"figure": label}
        for split, rows in parts.items():
            values = [value for row in rows if (value := _value(row, key)) is not None]
            statistics = [decimal(float(f(values)), digits) if values else "n/a" for f in (np.median, np.mean)]
            line |= dict(zip((f"{split}_median", f"{split}_mean"), statistics, strict=True))
            line[f"{split}_n"] = f"{len(values)} of {len(rows)}"
        if (not keys or key in keys) and any(not str(line[f"{split}_n"]).startswith("0 ") for split in parts):
            lines.append(line)
    return Table("figures", "Medians and means", "", tuple(columns), lines)


def counts(rows: Sequence[Row]) -> str:
    """Counts of scenes by outcome, with names, and of those on which our error is below COLMAP's, as sentences."""
    failed = _named(rows, lambda row: row["status"] in ("failed", "partial") and not row.get("missing"))
    missing = _named(rows, lambda row: bool(row.get("missing")))
    flagged = _named(rows, lambda row: bool(row.get("warnings")) and row["status"] not in ("failed", "partial"))
    silent = _named(rows, is_wrong_unflagged)
    told = (
        f"{len(rows)} scene{'s' * (len(rows) != 1)}: failed or partial {failed}, flagged by the adjustment {flagged}, "
        f"wrong and not flagged {silent}, without results of every stage {missing}."
    )
    taken = sorted({str(row["taken"]) for row in rows if row.get("taken")})
    told += f" Not estimated: {', '.join(taken)}." if taken else ""
    rivals = [_pair(row) for row in rows if row.get("colmap_error") and _has_path(row)]
    return f"{told} {ratios.counts(rivals)}".strip()


def is_wrong_unflagged(row: Row) -> bool:
    """Whether a result without warnings has an error above the limits."""
    if row["status"] in ("failed", "partial") or row.get("warnings"):
        return False
    limits = {"ate_percent": WRONG_ATE_PERCENT, "rotation_deg": WRONG_ROTATION_DEG}
    limits["focal_error_percent"] = WRONG_FOCAL_PERCENT
    return any(row.get(key) is not None and abs(row[key]) > limit for key, limit in limits.items())


def _pair(row: Row) -> Row:
    """Our complete path against COLMAP's, as a row for `ratios.counts`."""
    ours, other = row.get("ate_percent") if row["status"] == "ok" else None, row.get("colmap_percent")
    ratio = ours / other if ours is not None and other else None
    found = {"ate_percent": ours, "colmap_percent": other, "colmap_ratio": ratio, "true_masks_percent": None}
    return {"colmap": row["colmap_error"]} | found


def result_of(row: Row) -> str:
    """The outcome of a scene in a few words."""
    if row.get("missing"):
        return f"no results of {row['missing']}"
    if row["status"] in ("failed", "partial"):
        return f"{row['status']}: {row['failure']}" if row.get("failure") else str(row["status"])
    words = ["flagged" if row.get("warnings") else "wrong, not flagged" if is_wrong_unflagged(row) else "ok"]
    words += [str(row["status"]).removeprefix("degenerate truth: ")] if row["status"] != "ok" else []
    words += [f"with {row['taken']}"] if row.get("taken") else []
    words += ["older code"] if row.get("old") else []
    return ", ".join(words)


def _has_path(row: Row) -> bool:
    """Whether the true path of a scene defines an ATE, according to its row."""
    return row.get("rotation_deg") is None and not str(row["status"]).startswith(("degenerate", "no truth"))


def _value(row: Row, key: str) -> float | None:
    """A figure of a scene for the means; None for errors of partial and failed paths."""
    incomplete = row["status"] in ("failed", "partial")
    if incomplete and key in ("ate_percent", "rotation_deg", "focal_abs_percent"):
        return None
    if key == "focal_abs_percent":
        signed = row.get("focal_error_percent")
        return None if signed is None else abs(signed)
    value: float | None = row.get(key)
    return value


def _named(rows: Sequence[Row], chosen: Callable[[Row], bool]) -> str:
    names = [row["sequence"] for row in rows if chosen(row)]
    return f"{len(names)} ({', '.join(names)})" if names else "0"


def _still(row: Row) -> str:
    masked = row.get("masked_percent")
    return "" if masked is None else f"{decimal(masked, 2)} %"


def _spent(row: Row) -> str:
    """Wall and CPU seconds from the frames to the poses."""
    seconds = [row.get(key) for key in ("poses_s", "poses_cpu_s")]
    return " / ".join(decimal(value, 1) for value in seconds if value is not None)


def _several(values: Sequence[float | None], digits: int = 1) -> str:
    if all(value is None for value in values):
        return "n/a"
    return " / ".join("n/a" if value is None else decimal(value, digits) for value in values)
