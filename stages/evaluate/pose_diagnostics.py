"""What the adjustment decided about camera and focal length, on which numbers, and what speaks against its poses."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from stages.shared.artifacts import read_metadata
from stages.shared.tables import Column, Row, Table, read_rows

DECISIONS = ("camera", "focal", "focal_reason", "focal_sigma_percent", "doubts", "flags")
CAMERA_NAMES = {"rotating": "rotation-only"}
COLUMNS = (
    Column("camera", "camera"),
    Column("focal", "focal length"),
    Column("focal_sigma_percent", "predicted focal error", "%, one sigma", 1),
    Column("focal_reason", "why it was held", long=True),
    Column("doubts", "doubts"),
    Column("flags", "in words", long=True),
)
STATISTICS: Mapping[str, tuple[str, str, str]] = {
    "flow_px": (
        "flow between neighbouring frames",
        "px",
        "Where a rotation explains the flow, a camera with little of it is near-still, with more of it rotation-only.",
    ),
    "offset": (
        "long baseline",
        "frames",
        "Over so many frames the residuals below are taken: the longer, the more a moving camera shows.",
    ),
    "rotation_1_px": (
        "left by a rotation, neighbouring frames",
        "px",
        "At the focal length that suits a rotation best. Up to seven times what the epipolar geometry leaves of the "
        "same frames can be noise: more, here or on the next line, and the camera is moving.",
    ),
    "rotation_px": (
        "left by a rotation, long baseline",
        "px",
        "The same over more frames, where slow travel adds up.",
    ),
    "sampson_1_px": (
        "left by the epipolar geometry (Sampson), neighbouring frames",
        "px",
        "The noise of the flow between neighbours.",
    ),
    "sampson_px": (
        "left by the epipolar geometry (Sampson), median",
        "px",
        "The noise of the flow: what the other residuals are held against.",
    ),
    "homography_px": (
        "left by a homography, median",
        "px",
        "Hardly more than the epipolar residual: one plane fills half of the view, and starts from a plane compete.",
    ),
    "most_sampson_px": (
        "left by the epipolar geometry, of four matches in five",
        "px",
        "What the next line is held against.",
    ),
    "most_homography_px": (
        "left by a homography, of four matches in five",
        "px",
        "Hardly more than the line before: the scene is planar, which is a doubt.",
    ),
    "roughness": (
        "roughness of the camera path",
        "mean |a| / mean |v|",
        "Starts that fit equally well: the smoothest is taken. A rough path of a moving camera is a doubt.",
    ),
    "residual_px": (
        "left by the solution, median",
        "px",
        "Several times the epipolar residual is a doubt.",
    ),
    "focal_sigma_percent": (
        "predicted focal error",
        "%",
        "If the camera moves: small, the focal length is estimated; larger, weakly observed; beyond that, held.",
    ),
    "covariance_std_factor": (
        "factor in the predicted standard deviations",
        "",
        "Poses and focal length: so many times what independent residuals would predict; flow errors are alike over "
        "many pixels. Their covariance holds its square.",
    ),
    "static_percent": (
        "static area",
        "% of pixels",
        "Much less than in the round before is a doubt: masks may run away.",
    ),
}
"""By name in the metadata of poses.parquet: words, unit, and what it decides."""


def decisions(metadata: Mapping[str, Any]) -> Row:
    """The columns DECISIONS from the metadata of a poses.parquet; None for what it does not say."""
    focal, flags = metadata.get("focal", {}), metadata.get("flags", [])
    sigma = focal.get("relative_sigma") if focal.get("decision") != "known" else None
    return {
        "camera": CAMERA_NAMES.get(camera := str(metadata.get("camera", "")), camera) or None,
        "focal": focal.get("decision"),
        "focal_reason": focal.get("reason") or None,
        "focal_sigma_percent": None if sigma is None else 100 * sigma,
        "doubts": len(flags),
        "flags": "; ".join(flags) or None,
    }


def decision_table(poses: Sequence[Row]) -> Table:
    """The decisions of the last round on every sequence, from the rows of the pose table."""
    ours = (row for row in poses if row["method"] == "ours" and row.get("camera"))
    rows = [{key: row[key] for key in ("sequence", *DECISIONS)} for row in ours]
    note = (
        "By the numbers of the adjustment alone, after the last round. Of a focal length that was held, the predicted "
        "error is that of estimating it."
    )
    title = "What the adjustment took the camera for"
    return Table("adjustment", title, note, (Column("sequence", "sequence"), *COLUMNS), rows)


def statistic_rows(folder: Path) -> list[Row]:
    """A row per number on which the adjustment of the last round decided, for the results of a sequence."""
    if not (folder / "ba/poses.parquet").exists():
        return []
    about = read_metadata(folder / "ba/poses.parquet")
    found = about.get("statistics", {}) | {"residual_px": about.get("residual_px")}
    found["covariance_std_factor"] = about.get("covariance_std_factor")
    found["focal_sigma_percent"] = decisions(about)["focal_sigma_percent"]
    found["static_percent"] = 100 * about["static_share"] if "static_share" in about else None
    rows = []
    for name in [*STATISTICS, *(name for name in found if name not in STATISTICS)]:
        words, unit, decides = STATISTICS.get(name, (name, "", ""))
        if isinstance(value := found.get(name), int | float) and not isinstance(value, bool):
            about_it = {"statistic": words, "value": float(value), "unit": unit, "decides": decides}
            rows.append({"sequence": folder.name} | about_it)
    return rows


def statistics_table(rows: list[Row]) -> Table:
    """The numbers of every sequence, each with what it decides."""
    value = Column("statistic", "statistic"), Column("value", "value"), Column("unit", "unit")
    columns = (Column("sequence", "sequence"), *value, Column("decides", "what it decides", long=True))
    note = (
        "Measured without truth, in the last round: medians over pairs of frames, of confident static matches; pixels "
        "are those of the flow grid."
    )
    return Table("statistics", "On which numbers the adjustment decided", note, columns, rows)


def doubts_by_round(rows: Sequence[Row]) -> str:
    """The doubts about our poses in words, each after its round; empty if there are none.

    Args:
        rows: of the pose table, of one sequence.
    """
    told = [row for row in rows if row.get("flags")]
    rounds = ["last round" if row["method"] == "ours" else row["method"].removeprefix("ours, ") for row in told]
    return " ".join(f"{name.capitalize()}: {row['flags']}." for name, row in zip(rounds, told, strict=True))


def doubts_of(folder: Path) -> str:
    """The doubts of every evaluated round of a sequence; without an evaluation, those of the last round."""
    scores, poses = folder / "eval/poses.parquet", folder / "ba/poses.parquet"
    if scores.exists():
        return doubts_by_round(read_rows(scores))
    return "; ".join(read_metadata(poses).get("flags", [])) if poses.exists() else ""
