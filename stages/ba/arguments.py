"""A graph and a state in the form that the kernels take."""

import numpy as np

from stages.ba import kernel, reduced
from stages.ba.graph import FlowGraph
from stages.ba.state import BEYOND_INFINITY, INVERSE_DEPTHS, State
from stages.shared.lens import undistort

HELD_BELOW, NEVER = 0.9 * BEYOND_INFINITY, -1e9
"""Where movers are masked, a step holds inverse depths at the limit, and near it since the gauge moves them. Where they
are not it holds none: what moves leads beyond infinity, too, and would draw the cameras along."""


def observations(graph: FlowGraph, lens: np.ndarray | None = None) -> kernel.EdgeMatches:
    """The graph in the form that the kernels take; the pixels without the distortion `lens` of a `State`."""
    pixels = graph.pixels if lens is None else undistorted(graph, lens, graph.pixels)
    edges, held_below = (graph.pointer, graph.source, graph.target), HELD_BELOW if graph.masked else NEVER
    return kernel.EdgeMatches(*edges, pixels, graph.matches, graph.weights, held_below)


def limits(graph: FlowGraph) -> tuple[float, float]:
    """Range of the inverse depths in steps of the adjustment, relative to their median."""
    return (BEYOND_INFINITY if graph.masked else INVERSE_DEPTHS[0]), INVERSE_DEPTHS[1]


def undistorted(graph: FlowGraph, lens: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Pixels [..., 2] of the flow grid without the distortion `lens` [2] of a `State`."""
    radius = graph.corner_px
    return graph.centre + radius * undistort((pixels - graph.centre) / radius, lens)


def lens_px(graph: FlowGraph, state: State) -> np.ndarray:
    """The lens in the form that the kernels take."""
    return kernel.PINHOLE if state.lens is None else np.append(state.lens, graph.corner_px)


def geometry(graph: FlowGraph, state: State) -> kernel.Geometry:
    """The state in the form that the kernels take."""
    relative = reduced.relative_motions(graph, state.cam_from_world)
    R, t = np.ascontiguousarray(relative[:, :3, :3]), np.ascontiguousarray(relative[:, :3, 3])
    return kernel.Geometry(R, t, state.inverse_depth, state.focals_px, graph.centre)
