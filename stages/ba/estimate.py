"""Bundle adjustment from observations: the camera model that the flow asks for, and its solution."""

from dataclasses import replace

import numpy as np

from stages.ba import classify, diagnostics, ground
from stages.ba.classify import Statistics
from stages.ba.graph import MIN_MATCHES, FlowGraph, shared_matches
from stages.ba.options import BAOptions
from stages.ba.path import estimate_path
from stages.ba.problem import Estimate, Problem
from stages.ba.refinement import CONSISTENT_SHARE, consistent_share
from stages.ba.solution import failure
from stages.ba.state import FocalPrior
from stages.ba.turning import estimate_rotations, estimate_turning_zoom
from stages.ba.uncertainty import median_residual
from stages.ba.weights import mask_graph

PRIOR_FOCAL = 1.1
"""Centre of the focal length prior, in longer sides of the image (a field of view of 49 degrees along it)."""

PARALLAX = 0.7
"""A camera that seems to turn moves if a path leaves less than this share of the residual. Noise, fitted by a depth per
pixel, falls to .85 to .92 of it (pure_rotation, with and without a zoom of 1.3, rotation_static; zooms beside fast
cars; two rounds), and to .75 in three synthetic frames. Where a camera follows fast cars before a far wall, whose blur
hides the parallax of what is near, .32 to .46 are left; .61 where it dollies towards a hall without texture, while vans
pass between."""
NOISE_LEAVES = 0.85
"""Where a path leaves less than this share, but is not taken, the camera may move: less than noise leaves."""


def estimate(problem: Problem, options: BAOptions) -> Estimate:
    """Solve for poses, inverse depths and focal length. A failure is also returned, with its reason in `flags`.

    If the solution with masks fails checks and that without masks fails fewer, the masks are ignored: wrong masks do
    more harm than movers, which the robust kernel downweights in part.
    """
    solution = _best(problem, options)
    warnings = diagnostics.of_options(solution, options)
    if problem.unmasked is not None and solution.static is None and solution.camera != "failed":
        kept = ground.share_kept(problem.graph, problem.unmasked)
        warnings += diagnostics.of_near(kept, problem.known_focal_px is not None)
    return replace(solution, flags=solution.flags + warnings)


def _best(problem: Problem, options: BAOptions) -> Estimate:
    solution = _estimate(problem, options)
    if not solution.failed_checks or problem.unmasked is None:
        return solution
    plain = _estimate(replace(problem, graph=problem.unmasked, masked=False), options)
    failures, before = ((found.camera == "failed", len(found.failed_checks)) for found in (plain, solution))
    if failures >= before:
        return solution
    size = problem.graph.T, problem.graph.height, problem.graph.width
    static = np.ones(size, np.int8) if plain.static is None else plain.static
    flags = [f"masks ignored; with them: {'; '.join(solution.failed_checks)}", *plain.flags]
    return replace(plain, flags=flags, static=static)


def _estimate(problem: Problem, options: BAOptions) -> Estimate:
    graph, known = problem.graph, problem.known_focal_px
    moved_px = problem.previous and problem.previous.prior_px
    prior = FocalPrior(moved_px or PRIOR_FOCAL * graph.long_side_px)
    if not _observed(graph):
        return failure(graph, known or prior.focal_px)
    statistics = classify.measure(graph, known, options.seed)
    if not (problem.previous and problem.previous.alone):
        statistics = replace(statistics, ground=ground.at_rest(graph, prior, known))
    if statistics.camera == "rotating":
        rotations = estimate_rotations(problem, statistics, prior, options)
        if statistics.slow and rotations.focal["decision"] == "weakly observed":
            statistics = replace(statistics, turns=False)  # turns and travel past a wall look alike
        if statistics.turns and rotations.failed_checks and not statistics.by_ground:
            focal_px = rotations.state.focal_px
            again = classify.measure(graph, focal_px, options.seed, classify.longest_step(graph))
            statistics = replace(again, ground=statistics.ground)
        if statistics.camera == "rotating":
            return _unless_parallax(rotations, problem, statistics, prior, options)
    if not statistics.planar or options.zoom == "no" or known:
        return estimate_path(problem, statistics, prior, options, None)
    turning = estimate_turning_zoom(problem, statistics, prior)
    path = estimate_path(problem, statistics, prior, options, turning.zoom)
    return path if turning.zoom.decision != "changing" else better(path, turning, graph)


def _unless_parallax(
    rotations: Estimate, problem: Problem, statistics: Statistics, prior: FocalPrior, options: BAOptions
) -> Estimate:
    """The solution as a camera that turns, or a path where that is doubtful and a path explains far more."""
    if not statistics.doubtful:
        return rotations
    path = estimate_path(problem, replace(statistics, parallax=True), prior, options, None)
    found = better(path, rotations, problem.graph)
    return rotations if statistics.by_ground and found is not path else found


def better(path: Estimate, turning: Estimate, graph: FlowGraph) -> Estimate:
    """The path if it explains far more of the matches than turns do, and of the ground if that seems to rest.

    One that fails a check, as that of a shaking hand which is rough, must explain nearly all matches. The turns have a
    warning where a path that is not taken explains more than noise.
    """
    left, ground_left = _share_left(path, turning, graph), ground.share_left(graph, path.state, turning.state)
    sound = not path.failed_checks or consistent_share(graph, path.state) >= CONSISTENT_SHARE
    if sound and max(left, ground_left) < PARALLAX:
        return path
    if max(left, ground_left) >= NOISE_LEAVES and left >= PARALLAX:
        return turning
    warning = f"the camera may translate: a path would leave {left:.2f} of the residual of turns"
    but = [*path.failed_checks[:1], *([f"{ground_left:.2f} of it where the ground is"] if ground_left else [])]
    return replace(turning, flags=[*turning.flags, ", but ".join([warning, " and ".join(but)] if but else [warning])])


def _share_left(path: Estimate, turning: Estimate, graph: FlowGraph) -> float:
    """What a path leaves of the residual of turns, also of the matches alone that it takes for static."""
    kept = graph if path.static is None else mask_graph(graph, path.static)
    turning_px = min(turning.residual_px, median_residual(kept, turning.state))
    return path.residual_px / max(turning_px, 1e-12)


def _observed(graph: FlowGraph) -> bool:
    """Whether most pairs of neighbouring frames share at least MIN_MATCHES sure matches.

    Frames that share them with none, as the white ones of a strobe, are passed over; most must share them.
    """
    shared = shared_matches(graph.source, graph.target, graph.weights, graph.T)
    matched = np.flatnonzero((shared >= MIN_MATCHES).any(axis=1))
    if 2 * len(matched) <= graph.T:
        return False
    return bool(np.median(shared[matched[:-1], matched[1:]]) >= MIN_MATCHES)
