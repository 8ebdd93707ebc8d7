"""Uncertainty of a solution: its residuals, and the covariance predicted from them and the curvature of the cost."""

import numpy as np

from stages.ba import dba, reduced
from stages.ba.dba import State, Unknowns
from stages.ba.graph import MIN_WEIGHT, FlowGraph

CORRELATION = 20.0
"""Measured error over that predicted from independent residuals: flow errors are correlated over pixels and edges."""
MIN_NOISE_PX = 0.01
SIGMA_PX = 0.5
"""Robust scale, px, at which the curvature is computed."""


def median_residual(graph: FlowGraph, state: State) -> float:
    """Median reprojection error in px of the confident matches (infinite without any)."""
    errors = dba.errors_px(graph, state)[graph.weights > MIN_WEIGHT]
    return float(np.median(errors)) if errors.size else float("inf")


def focal_sigma(graph: FlowGraph, state: State, translation: bool = True) -> float:
    """Predicted relative standard deviation of the focal length with poses and depths marginalised.

    It is that of the mean over the frames where their focal lengths differ.
    """
    unknowns = Unknowns(focal=True, translation=translation, zoom=state.zoom is not None)
    return float(np.sqrt(solution_covariance(graph, state, unknowns)[6 * graph.T :, 6 * graph.T :].mean()))


def solution_covariance(graph: FlowGraph, state: State, unknowns: Unknowns) -> np.ndarray:
    """Covariance of a solution from the size of its residuals, scaled by `CORRELATION` squared.

    It is [6T + 1, 6T + 1], or [7T, 7T] where every frame has a focal length, with the prior on their curve; behind a
    lens it has two more rows.
    """
    S, _ = dba.linear_system(graph, state, SIGMA_PX, unknowns.translation, unknowns.zoom)
    if unknowns.zoom:
        focals = slice(6 * graph.T, 7 * graph.T)
        S[focals, focals] += dba.smoothness(graph.T)
    full = reduced.covariance(S, state.cam_from_world, unknowns.indices(graph.T))
    return full * (CORRELATION * max(median_residual(graph, state), MIN_NOISE_PX)) ** 2
