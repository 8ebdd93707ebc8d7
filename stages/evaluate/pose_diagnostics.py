"""Decisions of the bundle adjustment about camera and focal length, and its warnings."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from stages.shared.artifacts import read_metadata
from stages.shared.tables import Column, Row, Table, read_rows

DECISIONS = (
    *("camera", "focal", "focal_reason", "focal_sigma_percent", "zoom", "zoom_reason"),
    *("shutter", "shutter_reason", "loops", "warnings", "flags"),
)
CAMERA_NAMES = {"rotating": "rotation-only"}
COLUMNS = (
    Column("camera", "camera"),
    Column("focal", "focal length"),
    Column("focal_sigma_percent", "predicted focal error", "%, one sigma", 1),
    Column("focal_reason", "why it was held", long=True),
    Column("zoom", "its change over frames"),
    Column("zoom_reason", "why", long=True),
    Column("shutter", "shutter"),
    Column("shutter_reason", "why", long=True),
    Column("loops", "pairs of frames at a place seen again"),
    Column("warnings", "warnings"),
    Column("flags", "warnings in words", long=True),
)


def decisions(metadata: Mapping[str, Any]) -> Row:
    """The columns DECISIONS from the metadata of a poses.parquet; None for missing values."""
    focal, flags = metadata.get("focal", {}), metadata.get("flags", [])
    sigma = focal.get("relative_sigma") if focal.get("decision") != "known" else None
    return {
        "camera": CAMERA_NAMES.get(camera := str(metadata.get("camera", "")), camera) or None,
        "focal": focal.get("decision"),
        "focal_reason": focal.get("reason") or None,
        "focal_sigma_percent": None if sigma is None else 100 * sigma,
        "zoom": metadata.get("zoom", {}).get("decision"),
        "zoom_reason": metadata.get("zoom", {}).get("reason") or None,
        "shutter": metadata.get("rolling_shutter", {}).get("decision"),
        "shutter_reason": metadata.get("rolling_shutter", {}).get("reason") or None,
        "loops": _loops(metadata.get("statistics") or {}),
        "warnings": len(flags),
        "flags": "; ".join(flags) or None,
    }


def _loops(statistics: Mapping[str, Any]) -> str | None:
    """The number of loops, and of those left out, in words; None where the clip has none."""
    if "loops" not in statistics:
        return None
    left_out = statistics["loops_left_out"]
    return f"{statistics['loops']} joined" + (f", {left_out} left out" if left_out else "")


def decision_table(poses: Sequence[Row]) -> Table:
    """The decisions of the last round on every sequence, from the rows of the pose table."""
    ours = (row for row in poses if row["method"] == "ours" and row.get("camera"))
    rows = [{key: row.get(key) for key in ("sequence", *DECISIONS)} for row in ours]
    note = (
        "From the statistics of the bundle adjustment alone, after the last round. If a focal length was held, the "
        "predicted error is that of estimating it."
    )
    title = "Camera model chosen by the bundle adjustment"
    return Table("adjustment", title, note, (Column("sequence", "sequence"), *COLUMNS), rows)


def warnings_by_round(rows: Sequence[Row]) -> str:
    """The warnings about our poses in words, each after its round; empty if there are none.

    Args:
        rows: rows of the pose table of one sequence.
    """
    told = [row for row in rows if row.get("flags")]
    rounds = ["last round" if row["method"] == "ours" else row["method"].removeprefix("ours, ") for row in told]
    return " ".join(f"{name.capitalize()}: {row['flags']}." for name, row in zip(rounds, told, strict=True))


def warnings_of(folder: Path) -> str:
    """The warnings of every evaluated round of a sequence; without an evaluation, those of the last round."""
    scores, poses = folder / "eval/poses.parquet", folder / "ba/poses.parquet"
    if scores.exists():
        return warnings_by_round(read_rows(scores))
    return "; ".join(read_metadata(poses).get("flags", [])) if poses.exists() else ""
