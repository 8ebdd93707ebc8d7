"""What the adjustment writes: cameras of the full frame, their metadata, depth, convergence and the picture."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from stages.ba import dba, figure
from stages.ba.depth import DepthMaps
from stages.ba.graph import MIN_WEIGHT, FlowGraph
from stages.ba.options import BAOptions
from stages.ba.problem import Estimate
from stages.ba.uncertainty import CORRELATION
from stages.shared.artifacts import write_dense, write_table
from stages.shared.cameras import Cameras, intrinsics, make_cameras, scale_intrinsics
from stages.shared.flow_pairs import REACH
from stages.shared.sequences import Sequence

STATUS = {"moving": "estimated", "near-still": "near-still", "rotating": "rotation-only", "failed": "failed"}
JOINED_PX = 3.0
"""A loop is drawn if the median of its matches is at least as near as this."""
GAUGE = "the first camera is the world; the median inverse depth of the solver's pixels is 1"


def cameras_of(solution: Estimate, graph: FlowGraph, frames: Sequence, scale: float) -> Cameras:
    """Cameras for full-size frames; a frame without enough matches has the status "unobserved"."""
    focals_px = solution.state.focals_px
    Ks = intrinsics(focals_px, focals_px * graph.aspect, *graph.on_grid(graph.centre))
    status = np.full(graph.T, STATUS[solution.camera], object)
    if solution.camera != "failed":
        status[~graph.observed_frames()] = "unobserved"
    Ks = scale_intrinsics(Ks, 1 / scale)
    return make_cameras(solution.state.cam_from_world, Ks, np.array(frames.numbers), solution.covariance, status)


def pose_metadata(solution: Estimate, flags: list[str], static: np.ndarray, options: BAOptions) -> dict[str, Any]:
    """Metadata of poses.parquet: the decisions with their numbers, and the warnings.

    Args:
        static: [T, h, w] 1 static, 0 dynamic.
    """
    return {
        "camera": solution.camera,
        "focal": solution.focal,
        "zoom": asdict(solution.zoom),
        "rolling_shutter": asdict(solution.rolling),
        "statistics": {name: _or_null(value) for name, value in solution.statistics.items()},
        "residual_px": _or_null(solution.residual_px),
        "flags": flags,
        "static_share": float(static.mean()),
        "gauge": GAUGE,
        "covariance_std_factor": CORRELATION,
        "options": options.model_dump(),
    }


def _or_null(value: Any) -> Any:
    """The value; None in place of infinity and NaN, which JSON cannot hold."""
    return None if isinstance(value, float) and not np.isfinite(value) else value


def write_depth(path: Path, maps: DepthMaps, frames: Sequence, stride_px: float) -> None:
    """Write depth.arrow; `stride_px` full-frame pixels per pixel of the maps."""
    columns = {
        "frame": np.array(frames.numbers),
        "inverse_depth": maps.inverse_depth.astype(np.float32),
        "variance": maps.variance.astype(np.float32),
        "filled": maps.filled.astype(np.uint8),
    }
    units = "inverse depth in 1 / scene units; pixel k lies at full-frame pixel stride_px k + (stride_px - 1) / 2"
    write_dense(path, columns, {"stride_px": stride_px, "units": units})


def write_convergence(path: Path, solution: Estimate) -> None:
    """Write convergence.parquet, one row per iteration."""
    rows = [asdict(step) for step in solution.steps]
    names = ("sigma_px", "cost", "step", "damping", "focal_px", "accepted", "seconds")
    columns: dict[str, Any] = {"iteration": np.arange(len(rows)), "phase": [row["phase"] for row in rows]}
    columns |= {name: np.array([row[name] for row in rows]) for name in names}
    write_table(path, columns, {"units": "px, px^2, s"})


def draw(path: Path, name: str, solution: Estimate, graph: FlowGraph, cameras: Cameras, maps: DepthMaps) -> None:
    """Draw path, convergence, depth and residuals for the report."""
    every, sure = dba.errors_px(graph, solution.state), graph.weights > MIN_WEIGHT
    far = np.flatnonzero(graph.target - graph.source > REACH)
    joined = [e for e in far if sure[e].any() and np.median(every[e][sure[e]]) < JOINED_PX]
    loops = np.stack([graph.source[joined], graph.target[joined]], axis=1)
    title = f"{name}: camera {solution.camera}, focal length {solution.focal['decision']}"
    figure.draw(path, cameras.centres, solution.steps, maps.inverse_depth, every[sure], title, loops)
