"""A part of a long path: what need not be told from all of its frames is told from those that show it best."""

from dataclasses import replace

import numpy as np

from stages.ba.graph import MIN_WEIGHT, FlowGraph
from stages.ba.proposal import DENSE_FRAMES
from stages.ba.state import State

FRAMES = DENSE_FRAMES
"""Frames of a part."""


def best_part(values: np.ndarray) -> slice:
    """The FRAMES successive frames with the largest sum of `values` [T]; all of a shorter sequence."""
    sums = np.cumsum(np.append(0.0, values))
    first = int(np.argmax(sums[FRAMES:] - sums[:-FRAMES])) if len(values) > FRAMES else 0
    return slice(first, min(first + FRAMES, len(values)))


def flow_px(graph: FlowGraph) -> np.ndarray:
    """Median length of the confident flow from each frame to the next, [T]; 0 without any."""
    length = np.zeros(graph.T)
    for e in np.flatnonzero(graph.target - graph.source == 1):
        sure = graph.weights[e] > MIN_WEIGHT
        if sure.any():
            length[graph.source[e]] = np.median(np.linalg.norm(graph.matches[e] - graph.pixels, axis=1)[sure])
    return length


def state_of_part(state: State, inside: slice) -> State:
    """The state of the frames `inside`."""
    zoom = None if state.zoom is None else state.zoom[inside]
    return replace(
        state, cam_from_world=state.cam_from_world[inside], inverse_depth=state.inverse_depth[inside], zoom=zoom
    )
