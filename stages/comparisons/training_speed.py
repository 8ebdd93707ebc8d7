"""Speed of one training relative to another: milliseconds per step, and seconds to a PSNR that both reach."""

from collections.abc import Mapping

import numpy as np

from stages.shared.tables import Row

WINDOW = 50
"""Number of steps over which PSNR is averaged: a step sees one frame, and frames differ by several dB."""

Training = Mapping[str, np.ndarray]
"""`gaussians/convergence.parquet`: step, psnr (dB, of the step's training frame) and seconds, [n] each."""


def compare_training(run: Training, configured: Training) -> Row:
    """Milliseconds per step of a run, and seconds until it and the configured run reach the same PSNR.

    This PSNR is the highest one that both reach on training frames, averaged over WINDOW steps. All values are None if
    either training is shorter than that.
    """
    names = ("step_ms", "equal_psnr_db", "equal_s", "configured_equal_s")
    if min(len(run["step"]), len(configured["step"])) < WINDOW:
        return dict.fromkeys(names)
    curves = [_averaged(training["psnr"]) for training in (run, configured)]
    level = min(float(curve.max()) for curve in curves)
    reached = [_seconds_to(level, *pair) for pair in zip(curves, (run, configured), strict=True)]
    step_ms = 1e3 * float(np.median(np.diff(run["seconds"])))
    return dict(zip(names, (step_ms, level, *reached), strict=True))


def _averaged(psnr: np.ndarray) -> np.ndarray:
    """Means over windows [n - WINDOW + 1] of [n] values."""
    return np.convolve(psnr, np.full(WINDOW, 1 / WINDOW), mode="valid")


def _seconds_to(level: float, curve: np.ndarray, training: Training) -> float:
    """Seconds at the end of the first window whose mean is at least `level`."""
    return float(training["seconds"][WINDOW - 1 + int(np.argmax(curve >= level))])
