"""Solutions for cameras that only turn: rotations without translation and depth, at one focal length or one each."""

from dataclasses import replace

from stages.ba import classify, dba, diagnostics, rotation, shutter, zoom
from stages.ba.classify import Statistics
from stages.ba.options import BAOptions
from stages.ba.problem import Estimate, Focal, Problem
from stages.ba.refinement import BLIND_FOCAL, WEAK_FOCAL
from stages.ba.solution import CORRECTIONS, finish, rolling_evidence
from stages.ba.state import FocalPrior
from stages.ba.uncertainty import focal_sigma, median_residual
from stages.ba.zoom import Evidence


def estimate_rotations(problem: Problem, statistics: Statistics, prior: FocalPrior, options: BAOptions) -> Estimate:
    """The solution as a camera that turns at one focal length."""
    graph = problem.graph
    state, steps = rotation.solve_rotations(graph, prior, problem.known_focal_px)
    known = Focal("known", 0.0) if problem.known_focal_px else None
    rolling = rolling_evidence(graph, state, known or Focal("estimated", None), prior, options, translation=False)
    if rolling.decision == "rolling":
        for _ in range(CORRECTIONS):
            graph = shutter.correct(problem.graph, state, rolling.readout)
            state, steps = rotation.solve_rotations(graph, prior, problem.known_focal_px)
    sigma = focal_sigma(graph, state, translation=False)
    focal = known or Focal("weakly observed" if sigma > WEAK_FOCAL else "estimated", sigma)
    against = diagnostics.of_rotations(graph, dba.errors_px(graph, state))
    solution = finish(replace(problem, graph=graph), statistics, state, focal, against, steps)
    return replace(solution, rolling=rolling, flags=solution.flags + diagnostics.of_shutter(rolling))


def estimate_turning_zoom(problem: Problem, statistics: Statistics, prior: FocalPrior) -> Estimate:
    """The solution as a camera that turns and zooms; its decision is "constant" if that does not explain the flow."""
    graph = problem.graph
    state, steps = rotation.solve_rotations(graph, prior, None, zoom=True)
    sigma = focal_sigma(graph, state, translation=False)
    focal = Focal("weakly observed" if sigma > WEAK_FOCAL else "estimated", sigma)
    against = diagnostics.of_rotations(graph, dba.errors_px(graph, state))
    residual_px = median_residual(graph, state)
    turning = replace(statistics, rotation_1_px=residual_px, rotation_px=residual_px)
    solution = finish(problem, turning, state, focal, against, steps)
    noise_px = max(statistics.sampson_px, classify.FLOOR_PX)
    evidence = zoom.of_turning(graph, state, noise_px)
    if against or turning.camera != "rotating" or (evidence.decision == "changing" and sigma > BLIND_FOCAL):
        evidence = Evidence("constant", "a camera that turns and zooms does not explain the flow")
    return replace(solution, zoom=evidence)
