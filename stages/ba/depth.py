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
CUT_OFF = 1.6
"""Inverse depth of what the lower edge of the image cuts off, in units of that of the ground at the edge. The true one
is 1.3 to 1.9 (four tuned scenes); with 1.25 right-eye views of three of them are .4, 1.6 and 3.3 dB worse, movers in
held-out frames .5 and .6 better and .5 worse."""


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
    covered = static[first:end, : graph.rows * graph.stride, : graph.columns * graph.stride]
    shares = (cv2.resize(frame.astype(np.float32), shape[:0:-1], interpolation=cv2.INTER_AREA) for frame in covered)
    dynamic = np.stack([share < 0.5 for share in shares])
    if not observable:
        return DepthMaps(np.ones(shape), np.full(shape, MAX_VARIANCE), np.ones(shape, bool))
    inverse_depth, curvature = _search(graph, coarse, state, (first, end))
    variance = MATCH_VARIANCE / np.maximum(curvature, MATCH_VARIANCE / MAX_VARIANCE).reshape(shape)
    filled = dynamic | (variance >= MAX_VARIANCE)
    maps = inverse_depth.reshape(shape)
    complete = np.stack([fill(*frame) for frame in zip(maps, filled, dynamic, strict=True)])
    return DepthMaps(complete, np.where(filled, MAX_VARIANCE, variance), filled)


def joined(parts: Sequence[DepthMaps]) -> DepthMaps:
    """Maps of blocks of frames, one after the other."""
    columns = zip(*((part.inverse_depth, part.variance, part.filled) for part in parts), strict=True)
    return DepthMaps(*(np.concatenate(column) for column in columns))


def fill(inverse_depth: np.ndarray, missing: np.ndarray, dynamic: np.ndarray) -> np.ndarray:
    """Inverse depth [h, w] with its missing pixels filled.

    A dynamic region is assumed to stand where it touches the static ground: it gets one inverse depth, that of its
    contact. Other holes take the value of the nearest measured pixel.
    """
    if missing.all():
        return np.ones_like(inverse_depth)
    _, nearest = cv2.distanceTransformWithLabels(
        missing.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    measured = np.empty(nearest.max() + 1)
    measured[nearest[~missing]] = inverse_depth[~missing]
    filled = measured[nearest]
    count, regions = cv2.connectedComponents(dynamic.astype(np.uint8), connectivity=4)
    for label in range(1, count):
        region = regions == label
        filled[region] = contact_inverse_depth(region, inverse_depth, ~missing)
    return np.asarray(filled)


def contact_inverse_depth(region: np.ndarray, inverse_depth: np.ndarray, measured: np.ndarray) -> float:
    """Inverse depth at which a region [h, w] touches the static scene.

    The median over the measured pixels just below its lowest quarter. What the lower edge of the image cuts off touches
    the ground outside of the image, nearer than the near end (90th percentile) of the ground at the edge beside it: by
    how much nobody knows. At the depth of its surroundings it would lie behind the ground at its feet. If nothing is
    measured there, the near end (80th percentile) of the measurements around it, since the region occludes them.
    """
    ground = inverse_depth[_beside_cut(region) & measured]
    if ground.size:
        return CUT_OFF * float(np.percentile(ground, 90))
    rows = np.flatnonzero(region.any(axis=1))
    below = np.zeros_like(region)
    below[1:] = region[:-1] & ~region[1:]
    below[: rows[-1] + 2 - max(1, (rows[-1] - rows[0] + 1) // 4)] = False
    contact = inverse_depth[below & measured]
    if contact.size:
        return float(np.median(contact))
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    around = inverse_depth[(cv2.dilate(region.astype(np.uint8), cross, iterations=2) > 0) & measured]
    return float(np.percentile(around if around.size else inverse_depth[measured], 80))


def _beside_cut(region: np.ndarray) -> np.ndarray:
    """The lowest rows [h, w] beside a region that the lower edge of the image cuts off; false where it does not."""
    h, beside = len(region), np.zeros_like(region)
    cut = np.flatnonzero(region[-1])
    if cut.size:
        reach = max(8, cut.size)
        beside[h - max(2, h // 16) :, max(0, cut[0] - reach) : cut[-1] + 1 + reach] = True
    return beside & ~region


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
