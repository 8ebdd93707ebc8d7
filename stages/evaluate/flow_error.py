"""Errors of optical flow against true flow: by length of the motion, and how often confident flow is correct."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from stages.shared import sintel
from stages.shared.images import enlarge, read_mask
from stages.shared.sequences import Sequence

SPEEDS_PX = ((0.0, 10.0), (10.0, 40.0), (40.0, np.inf))
"""Classes of true motion, in full-size pixels."""
MIN_CONFIDENCE, RIGHT_PX = 0.5, 1.0
EPE = "mean distance of flow to the next frame from true flow, full-size pixels; occluded pixels included"
PROMISE = f"share of pixels with confidence > {MIN_CONFIDENCE} whose flow errs by less than {RIGHT_PX:g} px of the grid"


@dataclass(frozen=True)
class FlowErrors:
    """n valid pixels of the frames that have true flow.

    Attributes:
        error_px: [n] end-point error; motion_px: [n] length of the true flow; both in full-size pixels.
        confidence: [n] 0..1.
        visible: [n] bool, the pixel is visible in the next frame according to the ground truth.
        scale: width of the flow grid over that of the frame.
    """

    error_px: np.ndarray
    motion_px: np.ndarray
    confidence: np.ndarray
    visible: np.ndarray
    scale: float

    def right(self) -> np.ndarray:
        """Which of the m confident pixels have an error below RIGHT_PX of the flow grid, [m] bool."""
        return np.asarray(self.error_px[self.confidence > MIN_CONFIDENCE] * self.scale < RIGHT_PX)


def has_some_true_flow(sequence: Sequence) -> bool:
    """Whether any frame but the last has true flow."""
    return bool(set(sequence.numbers[:-1]) & set(sequence.truth.get("flow", {})))


def flow_errors(sequence: Sequence, flow: Mapping[str, np.ndarray]) -> FlowErrors:
    """Errors of the flow to the next frame over all frames that have true flow; there must be one.

    Args:
        flow: columns of flow/pairs.arrow.
    """
    parts = [_pair_errors(sequence, flow, e, number) for e, number in _scored_edges(sequence, flow)]
    error_px, motion_px, confidence, visible = (np.concatenate(column) for column in zip(*parts, strict=True))
    return FlowErrors(error_px, motion_px, confidence, visible, flow["flow"].shape[2] / sequence.width)


def flow_rows(sequence: Sequence, flow: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    """Rows `quantity, value, unit, n, protocol`, n in pixels; classes of motion without a pixel are left out."""
    if not any(_scored_edges(sequence, flow)):
        return []
    found = flow_errors(sequence, flow)
    rows = [_row("flow end-point error", found.error_px, "px", EPE)]
    if sequence.truth.get("occlusions"):
        protocol = EPE.replace("included", "left out")
        rows.append(_row("flow end-point error, visible", found.error_px[found.visible], "px", protocol))
    for low, high in SPEEDS_PX:
        moving = (found.motion_px >= low) & (found.motion_px < high)
        name = f"{low:g}-{high:g}" if np.isfinite(high) else f"{low:g}+"
        rows.append(_row(f"flow end-point error, motion {name} px", found.error_px[moving], "px", EPE))
    rows.append(_row("flow right where confident", 100.0 * found.right(), "%", PROMISE))
    share = 100.0 * (found.confidence > MIN_CONFIDENCE)
    rows.append(_row("flow confident", share, "%", f"share of valid pixels with confidence > {MIN_CONFIDENCE}"))
    return [row for row in rows if row["n"]]


def _scored_edges(sequence: Sequence, flow: Mapping[str, np.ndarray]) -> Iterator[tuple[int, int]]:
    """Rows of edges to the next frame and the number of their source frame, where there is true flow."""
    for e, (i, j) in enumerate(zip(flow["source"], flow["target"], strict=True)):
        if j == i + 1 and sequence.numbers[i] in sequence.truth.get("flow", {}):
            yield e, sequence.numbers[i]


def _pair_errors(sequence: Sequence, flow: Mapping[str, np.ndarray], e: int, number: int) -> tuple[np.ndarray, ...]:
    """Error, motion, confidence and visibility of the valid pixels of one edge, each [n]."""
    size = (sequence.width, sequence.height)
    scale = flow["flow"].shape[2] / sequence.width
    true = sintel.read_flo(sequence.truth["flow"][number])
    estimated = enlarge(flow["flow"][e].astype(np.float32), size) / scale
    confidence = enlarge(flow["confidence"][e].astype(np.float32), size)
    hidden, invalid = (_mask(sequence, kind, number) for kind in ("occlusions", "invalid"))
    maps = (np.linalg.norm(estimated - true, axis=-1), np.linalg.norm(true, axis=-1), confidence, ~hidden)
    return tuple(values[~invalid] for values in maps)


def _mask(sequence: Sequence, kind: str, number: int) -> np.ndarray:
    """A mask of the truth [H, W] bool, empty without a file."""
    path = sequence.truth.get(kind, {}).get(number)
    return read_mask(path) if path else np.zeros((sequence.height, sequence.width), bool)


def _row(quantity: str, values: np.ndarray, unit: str, protocol: str) -> dict[str, Any]:
    value = float(np.mean(values, dtype=np.float64)) if len(values) else float("nan")
    return {"quantity": quantity, "value": value, "n": len(values), "unit": unit, "protocol": protocol}
