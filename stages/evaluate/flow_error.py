"""Errors of optical flow against true flow: by length of the motion, and how often confident flow is correct."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from stages.shared import sintel
from stages.shared.artifacts import Dense
from stages.shared.images import enlarge, read_mask
from stages.shared.log import progress
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
        scale: width of the flow grid over that of the frame.
        error_px: [n] end-point error; motion_px: [n] length of the true flow; both in full-size pixels.
        confidence: [n] 0..1.
        visible: [n] bool, the pixel is visible in the next frame according to the ground truth.
    """

    scale: float
    error_px: np.ndarray
    motion_px: np.ndarray
    confidence: np.ndarray
    visible: np.ndarray

    def right(self) -> np.ndarray:
        """Which of the m confident pixels have an error below RIGHT_PX of the flow grid, [m] bool."""
        return np.asarray(self.error_px[self.confidence > MIN_CONFIDENCE] * self.scale < RIGHT_PX)


def has_some_true_flow(sequence: Sequence) -> bool:
    """Whether any frame but the last has true flow."""
    return bool(set(sequence.numbers[:-1]) & set(sequence.truth.get("flow", {})))


def flow_errors(sequence: Sequence, flow: Dense) -> FlowErrors:
    """Errors of the flow to the next frame over all frames that have true flow; there must be one.

    Args:
        flow: columns of flow/pairs.arrow.
    """
    parts = list(_errors_by_edge(sequence, flow))
    names = ("error_px", "motion_px", "confidence", "visible")
    joined = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
    return FlowErrors(parts[0].scale, *joined)


def flow_rows(sequence: Sequence, flow: Dense) -> list[dict[str, Any]]:
    """Rows `quantity, value, unit, n, protocol`, n in pixels; classes of motion without a pixel are left out."""
    sums: dict[tuple[str, str, str], tuple[float, int]] = {}
    for found in _errors_by_edge(sequence, flow):
        for name, values in _quantities(found, bool(sequence.truth.get("occlusions"))).items():
            total, n = sums.get(name, (0.0, 0))
            sums[name] = total + float(np.sum(values, dtype=np.float64)), n + len(values)
    return [
        {"quantity": quantity, "value": total / n, "n": n, "unit": unit, "protocol": protocol}
        for (quantity, unit, protocol), (total, n) in sums.items()
        if n
    ]


def _quantities(found: FlowErrors, with_visible: bool) -> dict[tuple[str, str, str], np.ndarray]:
    """The values of each row, by its quantity, unit and protocol."""
    values = {("flow end-point error", "px", EPE): found.error_px}
    if with_visible:
        protocol = EPE.replace("included", "left out")
        values["flow end-point error, visible", "px", protocol] = found.error_px[found.visible]
    for low, high in SPEEDS_PX:
        moving = (found.motion_px >= low) & (found.motion_px < high)
        name = f"{low:g}-{high:g}" if np.isfinite(high) else f"{low:g}+"
        values[f"flow end-point error, motion {name} px", "px", EPE] = found.error_px[moving]
    values["flow right where confident", "%", PROMISE] = 100.0 * found.right()
    sure = f"share of valid pixels with confidence > {MIN_CONFIDENCE}"
    return values | {("flow confident", "%", sure): 100.0 * (found.confidence > MIN_CONFIDENCE)}


def _errors_by_edge(sequence: Sequence, flow: Dense) -> Iterator[FlowErrors]:
    """The errors of one edge after the other; the flow that was read is given back."""
    scale = flow["flow"].shape[2] / sequence.width
    for e, number in progress(list(_scored_edges(sequence, flow)), "flow against truth"):
        yield FlowErrors(scale, *_pair_errors(sequence, flow, e, number))
        flow.release()


def _scored_edges(sequence: Sequence, flow: Dense) -> Iterator[tuple[int, int]]:
    """Rows of edges to the next frame and the number of their source frame, where there is true flow."""
    for e, (i, j) in enumerate(zip(flow["source"], flow["target"], strict=True)):
        if j == i + 1 and sequence.numbers[i] in sequence.truth.get("flow", {}):
            yield e, sequence.numbers[i]


def _pair_errors(sequence: Sequence, flow: Dense, e: int, number: int) -> tuple[np.ndarray, ...]:
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
