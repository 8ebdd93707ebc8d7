"""The statistics behind the decisions of the bundle adjustment, each with what it decides."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from stages.evaluate.pose_diagnostics import decisions
from stages.shared.artifacts import read_metadata
from stages.shared.tables import Column, Row, Table

ZOOM_NUMBERS = ("gain", "threshold", "gain_sigma", "change", "change_sigma")
SHUTTER_NUMBERS = ("gain", "threshold", "gain_sigma", "readout", "readout_sigma")
STATISTICS: Mapping[str, tuple[str, str, str]] = {
    "flow_px": (
        "flow between neighbouring frames",
        "px",
        "If a rotation explains the flow: with less than 0.2 px the camera is near-still, with more than 1 px it is "
        "rotation-only. Between them it is so if the rotation leaves no more than noise and tells the focal length.",
    ),
    "offset": (
        "long baseline",
        "frames",
        "Frame distance of the residuals below: the longer, the more parallax a moving camera shows.",
    ),
    "rotation_1_px": (
        "residual of a rotation, neighbouring frames",
        "px",
        "At the focal length that fits a rotation best. Up to seven times the epipolar residual of the same frames can "
        "be noise. If it is more, here or on the next line, the camera is moving, unless the ground rests; from half "
        "of that and 0.05 px on a path is solved beside the rotations, and taken if it leaves far less.",
    ),
    "rotation_px": (
        "residual of a rotation, long baseline",
        "px",
        "The same over more frames, where slow translation adds up.",
    ),
    "sampson_1_px": (
        "epipolar residual (Sampson), neighbouring frames",
        "px",
        "The noise of the flow between neighbours.",
    ),
    "sampson_px": (
        "epipolar residual (Sampson), long baseline, median",
        "px",
        "The noise of the flow: the other residuals are compared with it.",
    ),
    "ground": (
        "lower border at rest for a camera that turns",
        "share",
        "A moving camera shows parallax where the ground is. From 0.1 on a rotation may leave more than noise, unless "
        "a path leaves far less, of the ground too; below 0.05 such a path is looked for at any residual.",
    ),
    "homography_px": (
        "residual of a homography, long baseline, median",
        "px",
        "If it is hardly more than the epipolar residual, one plane fills half of the view, and initialisations from a "
        "plane are tried too.",
    ),
    "most_sampson_px": (
        "epipolar residual, 80th percentile",
        "px",
        "The next line is compared with it.",
    ),
    "most_homography_px": (
        "residual of a homography, 80th percentile",
        "px",
        "If it is hardly more than the line before, the scene is planar, which is a warning.",
    ),
    "roughness": (
        "roughness of the camera path",
        "mean |a| / mean |v|",
        "Among initialisations that fit equally well the smoothest is taken. A rough path of a moving camera is a "
        "warning.",
    ),
    "loops": (
        "pairs of frames joined at a place seen again",
        "",
        "Frames more than 64 apart, found by their looks and checked by geometry. The error of the path between them "
        "is spread over it before the adjustment.",
    ),
    "loops_left_out": (
        "such pairs left out",
        "",
        "Others contradict them, or they bend the path beyond its drift.",
    ),
    "loop_gap_percent": (
        "gap of the path where it closed, median",
        "% of the path between",
        "The drift of the path before: what closing removed.",
    ),
    "residual_px": (
        "residual of the solution, median",
        "px",
        "Several times the epipolar residual is a warning.",
    ),
    "focal_sigma_percent": (
        "predicted focal error",
        "%",
        "If the camera moves: with a small error the focal length is estimated, with a larger one it is weakly "
        "observed, with a still larger one it is held at the prior.",
    ),
    "zoom_gain_percent": (
        "held-out cost that a focal length per frame saves",
        "%",
        "Cameras are fitted to every other tile of the image and compared on the tiles between, by the mean of the "
        "middle half of them. If this is above the next two lines, and the change below above its error, the focal "
        "length changes.",
    ),
    "zoom_threshold_percent": ("the least saving that counts", "%", "See the line before."),
    "zoom_gain_sigma_percent": (
        "standard error of the saving over the tiles",
        "%",
        "A saving of less than four of them may be chance.",
    ),
    "zoom_change_percent": (
        "change of the focal length, if it changes",
        "%, largest over smallest",
        "It must exceed three of its predicted errors, else it is not observable.",
    ),
    "zoom_change_sigma_percent": (
        "predicted error of the change",
        "%",
        "From 8 % on a change is not observable, and the focal length is held constant.",
    ),
    "shutter_gain_percent": (
        "held-out cost that a rolling shutter saves",
        "%",
        "Compared as for the zoom, but by the cost of all tiles together. If this is above the next two lines, and the "
        "readout below above three of its errors, rows are exposed one after the other.",
    ),
    "shutter_threshold_percent": ("the least saving that counts", "%", "See the line before."),
    "shutter_gain_sigma_percent": (
        "standard error of the saving over the tiles",
        "%",
        "A saving of less than three of them may be chance.",
    ),
    "shutter_readout_percent": (
        "readout, from the first row to the last",
        "% of the frame interval",
        "Negative if the last row comes first.",
    ),
    "shutter_readout_sigma_percent": (
        "predicted error of the readout",
        "% of the frame interval",
        "From 15 % on a rolling shutter is not observable, and all rows count as exposed at once.",
    ),
    "covariance_std_factor": (
        "factor in the predicted standard deviations",
        "",
        "Standard deviations of poses and focal length are this many times those of independent residuals, since flow "
        "errors are correlated over many pixels. The covariance holds its square.",
    ),
    "static_percent": (
        "static area",
        "% of pixels",
        "Much less than in the previous round is a warning: masks may grow without bound.",
    ),
}
"""By name in the metadata of poses.parquet: label, unit, and what it decides."""


def statistic_rows(folder: Path) -> list[Row]:
    """A row per statistic behind the decisions of the last round, from the results folder of a sequence."""
    if not (folder / "ba/poses.parquet").exists():
        return []
    about = read_metadata(folder / "ba/poses.parquet")
    found = about.get("statistics", {}) | {"residual_px": about.get("residual_px")}
    found["covariance_std_factor"] = about.get("covariance_std_factor")
    found["focal_sigma_percent"] = decisions(about)["focal_sigma_percent"]
    zoom, rolling = about.get("zoom", {}), about.get("rolling_shutter", {})
    found |= {f"zoom_{name}_percent": 100 * zoom[name] for name in ZOOM_NUMBERS if zoom.get(name) is not None}
    if rolling.get("gain") is not None:
        found |= {f"shutter_{name}_percent": 100 * rolling[name] for name in SHUTTER_NUMBERS}
    if zoom.get("change") is not None:
        found["zoom_change_percent"] = 100 * float(np.expm1(zoom["change"]))
    found["static_percent"] = 100 * about["static_share"] if "static_share" in about else None
    rows = []
    for name in [*STATISTICS, *(name for name in found if name not in STATISTICS)]:
        words, unit, decides = STATISTICS.get(name, (name, "", ""))
        if isinstance(value := found.get(name), int | float) and not isinstance(value, bool):
            about_it = {"statistic": words, "value": float(value), "unit": unit, "decides": decides}
            rows.append({"sequence": folder.name} | about_it)
    return rows


def statistics_table(rows: list[Row]) -> Table:
    """The statistics of every sequence, each with the decision that depends on it."""
    value = Column("statistic", "statistic"), Column("value", "value"), Column("unit", "unit")
    columns = (Column("sequence", "sequence"), *value, Column("decides", "what it decides", long=True))
    note = (
        "Measured without ground truth, in the last round: medians over pairs of frames, of confident static matches; "
        "pixels are those of the flow grid."
    )
    return Table("statistics", "Statistics behind the decisions of the bundle adjustment", note, columns, rows)
