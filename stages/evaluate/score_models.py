"""Rows of the check table on the model: residual of the tracks under the control points, and file sizes."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stages.evaluate.score_geometry import check_row
from stages.shared.artifacts import read_metadata, read_model
from stages.shared.split import frame_times

STUCK = "motion fit stuck"
MEDIAN, P90 = "motion fit residual, median", "motion fit residual, 90th percentile"
FIT_PROTOCOL = "reprojection error of the tracks of dynamic pixels, moved by the control points; n: tracks"
STUCK_PROTOCOL = "100: the residual of the control points on the tracks is too large; n: attempts"
COUNT_PROTOCOL = "control points of the motion; n: attempts at the fit, repeated where it is stuck"
FILE_PROTOCOL = "size of the file; n: Gaussians"
HALF_PROTOCOL = "mean over a few training frames rendered from the file in half precision; n: Gaussians"
COMPUTED_PROTOCOL = (
    "computed, no such model is made: our full file with a quaternion and a translation (7 float32) per dynamic "
    "Gaussian and frame in which it can be seen, in place of the control points and their motion; n: dynamic Gaussians"
)
MOTION_PREFIX = "deformation."
MOTION_BYTES = 7 * 4
MIN_ALPHA = 1 / 255
"""Least opacity that is drawn (`stages.splatting.raster_bins`, which would bring torch and its memory along)."""


def model_rows(name: str, frames: int, motion: Path, full: Path, half: Path) -> list[dict[str, Any]]:
    """Rows `sequence, quantity, value, unit, n, protocol` of one sequence.

    Args:
        frames: number of frames of the sequence.
        motion: control/deformation.safetensors. full, half: the model files of the Gaussians.
    """
    rows = [*_motion_rows(read_metadata(motion)), *_file_rows(frames, full, half)]
    return [{"sequence": name} | row for row in rows]


def _motion_rows(fit: dict[str, Any]) -> list[dict[str, Any]]:
    """Residual, control points and status of the fit; no row where there is no motion to fit."""
    if "median_px" not in fit:
        return []
    tracks, attempts = fit["tracks"], fit["attempts"]
    return [
        check_row(MEDIAN, fit["median_px"], tracks, "px", FIT_PROTOCOL),
        check_row(P90, fit["p90_px"], tracks, "px", FIT_PROTOCOL),
        check_row("control points", fit["control_points"], attempts, "points", COUNT_PROTOCOL),
        check_row(STUCK, 100.0 * (fit["status"] == "stuck"), attempts, "% of sequences", STUCK_PROTOCOL),
    ]


def _file_rows(frames: int, full: Path, half: Path) -> list[dict[str, Any]]:
    settings, quality = read_metadata(full), read_metadata(half)
    dynamic = settings["n_dynamic"]
    N = settings["n_static"] + dynamic
    rows = [
        check_row("model file", full.stat().st_size / 1e6, N, "MB", FILE_PROTOCOL),
        check_row("model file, half precision", half.stat().st_size / 1e6, N, "MB", FILE_PROTOCOL),
        check_row("PSNR in half precision", quality["training_psnr_db"], N, "dB", HALF_PROTOCOL),
        check_row("PSNR lost by half precision", quality["psnr_loss_db"], N, "dB", HALF_PROTOCOL),
    ]
    if dynamic:
        tensors = read_model(full)
        ours = sum(values.nbytes for key, values in tensors.items() if key.startswith(MOTION_PREFIX))
        megabytes = (full.stat().st_size - ours + _sightings(tensors, dynamic, frames) * MOTION_BYTES) / 1e6
        name = "computed: model file with a motion per Gaussian and frame"
        rows.append(check_row(name, megabytes, dynamic, "MB", COMPUTED_PROTOCOL))
    return rows


def _sightings(tensors: Mapping[str, np.ndarray], dynamic: int, frames: int) -> int:
    """Number of pairs of a dynamic Gaussian and a frame in which its opacity can be seen; all without life spans."""
    if "births" not in tensors:
        return dynamic * frames
    opacities = 1 / (1 + np.exp(-tensors["logits"][-dynamic:]))
    spans = np.exp(tensors["log_spans"])
    moments = [opacities * np.exp(-0.5 * ((time - tensors["births"]) / spans) ** 2) for time in frame_times(frames)]
    return sum(int((opacity > MIN_ALPHA).sum()) for opacity in moments)


def stuck_fits(rows: list[dict[str, Any]]) -> list[str]:
    """One sentence per sequence of the check table whose motion fit is stuck."""
    values = {(row["sequence"], row["quantity"]): row for row in rows}
    return [
        f"{name}: the fit of the control points is stuck after {row['n']} attempts (residual "
        f"{values[name, MEDIAN]['value']:.2f} px, 90th percentile {values[name, P90]['value']:.2f} px)."
        for (name, quantity), row in values.items()
        if quantity == STUCK and row["value"] > 0
    ]
