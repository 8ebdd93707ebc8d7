"""Uncertainty of a solution: its residuals, and the covariance predicted from them and the curvature of the cost."""

from dataclasses import dataclass

import numpy as np

from stages.ba import dba
from stages.ba.banded_system import BandedCovariance
from stages.ba.dense_system import DenseCovariance
from stages.ba.graph import MIN_WEIGHT, FlowGraph
from stages.ba.proposal import linear_system
from stages.ba.state import State, Unknowns

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
    focals = graph.T if unknowns.zoom else 1
    mean = np.concatenate(
        [np.zeros(6 * graph.T), np.full(focals, 1 / focals), np.zeros(0 if state.lens is None else 2)]
    )
    return float(np.sqrt(solution_covariance(graph, state, unknowns).of(mean[None])[0, 0]))


@dataclass(frozen=True)
class Covariance:
    """Covariance of a solution: `inverse` of its curvature times `variance`."""

    inverse: DenseCovariance | BandedCovariance
    variance: float

    def of(self, directions: np.ndarray) -> np.ndarray:
        """Covariance [k, k] of k linear combinations [k, n] of all unknowns: twists, log focals, lens."""
        return self.inverse.of(directions) * self.variance

    def poses(self, T: int) -> np.ndarray:
        """Covariance [T, 6, 6] of the left twist of every pose."""
        return self.inverse.poses(T) * self.variance


def solution_covariance(graph: FlowGraph, state: State, unknowns: Unknowns) -> Covariance:
    """Covariance of a solution from the size of its residuals, scaled by `CORRELATION` squared.

    The first pose and the scale of the trajectory are fixed; where every frame has a focal length, the prior on their
    curve counts.
    """
    system = linear_system(graph, state, SIGMA_PX, unknowns)
    variance = (CORRELATION * max(median_residual(graph, state), MIN_NOISE_PX)) ** 2
    return Covariance(system.covariance(), variance)
