"""Rows of the check table about radial distortion: its coefficients, and their error where the truth is known."""

from typing import Any

import numpy as np

from stages.evaluate.score_geometry import check_row
from stages.shared import sintel
from stages.shared.artifacts import read_json
from stages.shared.cameras import Cameras
from stages.shared.lens import distort
from stages.shared.sequences import Sequence

PROTOCOL = "k1 and k2 as in OpenCV and COLMAP's RADIAL, of the lens that frames were freed of, at our mean focal length"
CORNER = (
    "distance in px of the original frame between where our lens and the true one show a corner of the undistorted one"
)


def lens_rows(sequence: Sequence, lens: dict[str, Any], cameras: Cameras) -> list[dict[str, Any]]:
    """Rows `sequence, quantity, value, unit, n, protocol`; none if frames were used as they are.

    Args:
        lens: content of lens/lens.json. cameras: ours.
    """
    if lens["coefficients_px"] is None:
        return []
    ours = np.array(lens["coefficients_px"])
    k = ours * np.exp(np.log(cameras.Ks[:, 0, 0]).mean()) ** np.array([2, 4])
    rows = [
        check_row(f"radial distortion, {name}", value, 1, "", PROTOCOL)
        for name, value in zip(("k1", "k2"), k, strict=True)
    ]
    if sequence.truth.get("distortion") and sequence.has_truth("camdata_left"):
        first = sequence.numbers[0]
        K, _ = sintel.read_cam(sequence.truth["camdata_left"][first])
        about = read_json(sequence.truth["distortion"][first])
        true = np.array([about["k1"], about["k2"]]) / K[0, 0] ** np.array([2, 4])
        corner = np.array([sequence.width - 1, sequence.height - 1]) / 2
        apart = np.linalg.norm(distort(corner, ours) - distort(corner, true))
        rows.append(check_row("error of the lens at a corner", float(apart), 1, "px", CORNER))
    return [{"sequence": sequence.name} | row for row in rows]
