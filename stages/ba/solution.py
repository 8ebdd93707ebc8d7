"""What is said of any solution: its covariance, the decision about the focal length, warnings, the shutter."""

from dataclasses import asdict

import numpy as np

from stages.ba import checkpoint, diagnostics, shutter
from stages.ba.classify import Statistics
from stages.ba.graph import FlowGraph
from stages.ba.options import BAOptions
from stages.ba.problem import Estimate, Focal, Problem
from stages.ba.state import FocalPrior, State, Step, Unknowns
from stages.ba.uncertainty import median_residual, solution_covariance

CORRECTIONS = 2
"""Corrections of the matches for a rolling shutter, each from a better solution than the one before."""


def finish(
    problem: Problem, statistics: Statistics, state: State, focal: Focal, against: list[str], steps: list[Step]
) -> Estimate:
    """The solution with its covariance, statistics and warnings; `against` are the checks that it fails."""
    graph = problem.graph
    free = focal.decision in ("estimated", "weakly observed")
    unknowns = Unknowns(free, statistics.camera != "rotating", free and state.zoom is not None)
    covariance = checkpoint.array(lambda: solution_covariance(graph, state, unknowns).poses(graph.T))
    decision = asdict(focal) | {"focal_px": state.focal_px}
    flags = list(against)
    if statistics.planar:
        flags.append("planar scene: one homography explains the flow, so that depth and motion rest on one plane")
    flags += diagnostics.of_ground(statistics)
    flags += diagnostics.of_focal(statistics.camera, decision)
    flags += diagnostics.of_path(state.cam_from_world, covariance)
    numbers = asdict(statistics) | {"camera": statistics.camera, "planar": statistics.planar}
    residual_px = median_residual(graph, state)
    return Estimate(state, statistics.camera, covariance, residual_px, decision, numbers, against, flags, steps)


def failure(graph: FlowGraph, focal_px: float) -> Estimate:
    """The result where nothing can be solved: a camera at rest."""
    T = graph.T
    state = State(np.tile(np.eye(4), (T, 1, 1)), np.ones((T, len(graph.pixels))), focal_px)
    reason = "failed: neighbouring frames share too few confident static matches; the poses are the identity"
    focal = asdict(Focal("held at prior", None, "nothing could be estimated")) | {"focal_px": focal_px}
    return Estimate(state, "failed", np.zeros((T, 6, 6)), float("inf"), focal, {}, [reason], [reason])


def rolling_evidence(
    graph: FlowGraph,
    state: State,
    focal: Focal,
    prior: FocalPrior,
    options: BAOptions,
    translation: bool = True,
    may_assume: bool = True,
) -> shutter.Evidence:
    """Evidence for a rolling shutter from the solution without one.

    Args:
        may_assume: whether it is taken without a test if the options say so. The rows of a camera that hardly moves
            differ by less than the noise, to which the readout would be fitted.
    """
    if options.rolling_shutter == "no":
        return shutter.NOT_TESTED
    free = focal.decision in ("estimated", "weakly observed")
    unknowns = Unknowns(free, translation, free and state.zoom is not None)
    return shutter.weigh(graph, state, unknowns, prior, may_assume and options.rolling_shutter == "yes")
