"""Rows of the check table: checks without ground truth, and errors of flow and depth where ground truth exists."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from stages.evaluate import flow_check
from stages.evaluate.flow_error import flow_rows, has_some_true_flow
from stages.shared import sintel
from stages.shared.artifacts import Dense
from stages.shared.cameras import Cameras, frame_from_grid, has_pose, pixel_grid
from stages.shared.log import progress
from stages.shared.sequences import Sequence

FAR = 10.0  # true depths beyond this many medians (sky) are left out
DEPTH_PROTOCOL = (
    "1 / inverse depth against true z-depth on triangulated static pixels nearer than 10 true medians, "
    "after one median scale for the sequence"
)


def score_geometry(
    sequence: Sequence,
    flow: Dense,
    cameras: Cameras,
    depth: Mapping[str, np.ndarray],
    stride_px: float,
    masks: Mapping[int, np.ndarray],
) -> list[dict[str, Any]]:
    """Rows `quantity, value, unit, n, protocol` of one sequence.

    Args:
        flow: columns of flow/pairs.arrow.
        cameras, depth: our last poses and the columns of ba/depth.arrow, a value per `stride_px` pixels.
        masks: our dynamic masks [H, W] by frame number.
    """
    _, height, width = depth["inverse_depth"].shape
    uv = frame_from_grid(pixel_grid(height, width), stride_px)
    static = static_pixels(sequence, masks, uv) & (depth["filled"] == 0) & (depth["inverse_depth"] > 0)
    residuals = edge_residuals(sequence, flow, cameras, depth["inverse_depth"], uv, static)
    rows = _residual_rows(residuals)
    posed = has_pose(cameras)
    rows.append(check_row("frames with a pose", posed.sum(), len(posed), "frames", "status of ba/poses.parquet"))
    if has_some_true_flow(sequence):
        rows += flow_rows(sequence, flow)
    if sequence.has_truth("depth"):
        rows += _depth_rows(sequence, depth["inverse_depth"], uv, static)
    return [{"sequence": sequence.name} | row for row in rows]


def check_row(quantity: str, value: float, n: int, unit: str, protocol: str) -> dict[str, Any]:
    """A row of the check table but for its sequence: `n` is how many values went in."""
    return {"quantity": quantity, "value": float(value), "n": n, "unit": unit, "protocol": protocol}


def static_pixels(sequence: Sequence, masks: Mapping[int, np.ndarray], uv: np.ndarray) -> np.ndarray:
    """Where our masks call the full-frame pixels uv [h, w, 2] static, [T, h, w] bool."""
    u, v = np.moveaxis(np.rint(uv).astype(int), -1, 0)
    return np.stack([~masks[number][v, u] for number in sequence.numbers])


def edge_residuals(
    sequence: Sequence,
    flow: Dense,
    cameras: Cameras,
    inverse_depth: np.ndarray,
    uv: np.ndarray,
    static: np.ndarray,
) -> np.ndarray:
    """Flow residuals [n] in full-frame pixels over all edges, on confident pixels of `static` [T, h, w]."""
    scale = flow["flow"].shape[2] / sequence.width
    residuals = []
    ends = list(zip(flow["source"].tolist(), flow["target"].tolist(), strict=True))
    for e, (i, j) in enumerate(progress(ends, "residuals of flow")):
        used = static[i] & (flow_check.sample(flow["confidence"][e], uv, scale) > flow_check.MIN_CONFIDENCE)
        flow_px = flow_check.sample(flow["flow"][e], uv[used], scale).astype(float) / scale
        source, target = ((cameras.cam_from_world[k], cameras.Ks[k]) for k in (i, j))
        depths = inverse_depth[i][used].astype(float)
        flow.release()
        residuals.append(flow_check.flow_residuals(uv[used], depths, flow_px, source, target))
    return np.concatenate(residuals)


def _residual_rows(residuals: np.ndarray) -> list[dict[str, Any]]:
    if not len(residuals):
        return []
    n, protocol = len(residuals), flow_check.PROTOCOL
    median, high = np.percentile(residuals, [50, 90])
    return [
        check_row("flow residual, median", median, n, "px", protocol),
        check_row("flow residual, 90th percentile", high, n, "px", protocol),
        check_row("flow residual below 1 px", 100 * float(np.mean(residuals < 1)), n, "%", protocol),
    ]


def _depth_rows(
    sequence: Sequence, inverse_depth: np.ndarray, uv: np.ndarray, static: np.ndarray
) -> list[dict[str, Any]]:
    u, v = np.moveaxis(np.rint(uv).astype(int), -1, 0)
    true = np.stack([sintel.read_dpt(sequence.truth["depth"][number])[v, u] for number in sequence.numbers])
    used = static & (true < FAR * np.median(true, axis=(1, 2), keepdims=True))
    if not used.any():
        return []
    ratio = 1 / (inverse_depth[used].astype(float) * true[used])
    ratio /= np.median(ratio)
    close = 100 * float(np.mean(np.maximum(ratio, 1 / ratio) < 1.25))
    return [
        check_row("depth error (AbsRel)", 100 * float(np.mean(np.abs(ratio - 1))), len(ratio), "%", DEPTH_PROTOCOL),
        check_row("depth within 25 %", close, len(ratio), "%", DEPTH_PROTOCOL),
    ]
