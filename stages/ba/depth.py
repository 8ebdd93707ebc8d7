"""Output depth of bundle adjustment: denser than the solver's grid, with variance, holes filled."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from stages.ba import dba
from stages.ba.graph import FlowGraph
from stages.ba.initialise import SWEEP
from stages.ba.state import INVERSE_DEPTHS, State

MATCH_VARIANCE = 0.25
"""Variance of one component of a match, px^2. The median depth error against ground truth is then half a sigma."""
MAX_VARIANCE = 1.0
"""Largest variance, in units of the squared median inverse depth; depths with it count as not triangulated."""
SIGMA_PX = 0.5
SPAN = np.array([0.5, 0.7, 1.0, 1.4, 2.0])
"""Factors on the coarse inverse depth from which the search for a pixel's inverse depth starts."""


@dataclass(frozen=True)
class DepthMaps:
    """Inverse depths [T, h, w] in the gauge of the poses, their variance, and where they are filled in."""

    inverse_depth: np.ndarray
    variance: np.ndarray
    filled: np.ndarray


def depth_maps(
    graph: FlowGraph,
    coarse: FlowGraph,
    state: State,
    static: np.ndarray,
    observable: bool,
    frames: tuple[int, int] | None = None,
) -> DepthMaps:
    """Inverse depth of every pixel of `graph` with the poses fixed; holes filled.

    Args:
        graph: masked observations on the output grid; `coarse`: those on which `state` was solved.
        static: [T, height, width], 1 where static, on the flow grid.
        observable: false for a camera that does not translate: every depth is then filled with 1.
        frames: first and end of those to measure, whose edges alone are in `graph`; None: all.
    """
    first, end = frames or (0, graph.T)
    shape = (end - first, graph.rows, graph.columns)
    if not observable:
        return DepthMaps(np.ones(shape), np.full(shape, MAX_VARIANCE), np.ones(shape, bool))
    inverse_depth, curvature = _search(graph, coarse, state, (first, end))
    variance = MATCH_VARIANCE / np.maximum(curvature, MATCH_VARIANCE / MAX_VARIANCE).reshape(shape)
    filled = dynamic_pixels(static[first:end], graph.stride) | (variance >= MAX_VARIANCE)
    complete = np.stack([fill(*frame) for frame in zip(inverse_depth.reshape(shape), filled, strict=True)])
    return DepthMaps(complete, np.where(filled, MAX_VARIANCE, variance), filled)


def dynamic_pixels(static: np.ndarray, stride: int) -> np.ndarray:
    """Which cells [n, rows, columns] of `stride` px are dynamic by `static` [n, height, width], 1 where static."""
    rows, columns = (length // stride for length in static.shape[1:])

    def of_frame(frame: np.ndarray) -> np.ndarray:
        covered = frame[: rows * stride, : columns * stride].astype(np.float32)
        return np.asarray(cv2.resize(covered, (columns, rows), interpolation=cv2.INTER_AREA) < 0.5)

    return np.stack([of_frame(frame) for frame in static])


def joined(parts: Sequence[DepthMaps]) -> DepthMaps:
    """Maps of blocks of frames, one after the other."""
    columns = zip(*((part.inverse_depth, part.variance, part.filled) for part in parts), strict=True)
    return DepthMaps(*(np.concatenate(column) for column in columns))


def fill(inverse_depth: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Inverse depth [h, w] with the nearest measured one where it is missing; 1 if none is measured."""
    if missing.all():
        return np.ones_like(inverse_depth)
    _, nearest = cv2.distanceTransformWithLabels(
        missing.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    measured = np.empty(nearest.max() + 1)
    measured[nearest[~missing]] = inverse_depth[~missing]
    return np.asarray(measured[nearest])


def _search(
    graph: FlowGraph, coarse: FlowGraph, state: State, frames: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Inverse depth and curvature [n, P] of the fine pixels, searched near the coarse solution and over all depths."""
    first, end = frames
    solved = state.inverse_depth[first:end].reshape(end - first, coarse.rows, coarse.columns)
    start = np.maximum(graph.resample(solved, coarse.stride), INVERSE_DEPTHS[0])
    around = start * SPAN[:, None, None]
    everywhere = np.broadcast_to(SWEEP[:, None, None], (len(SWEEP), *start.shape))
    leaving, fine = _beginning_with(graph, replace(state, inverse_depth=start), frames)
    return dba.sweep(leaving, fine, np.concatenate([around, everywhere]), SIGMA_PX)


def _beginning_with(graph: FlowGraph, state: State, frames: tuple[int, int]) -> tuple[FlowGraph, State]:
    """Edges and cameras counted from the first of the `frames` on, in a circle; no edge leaves other frames."""
    first, end = frames
    source, target = graph.source - first, (graph.target - first) % graph.T
    leaving = replace(graph, source=source, target=target, pointer=graph.pointer[first : end + 1])
    zoom = None if state.zoom is None else np.roll(state.zoom, -first)
    return leaving, replace(state, cam_from_world=np.roll(state.cam_from_world, -first, axis=0), zoom=zoom)
