"""Bundle adjustment from observations: camera model, initialisation, refinement, focal length, diagnostics."""

from dataclasses import asdict, replace

import numpy as np

from stages.ba import checkpoint, classify, dba, diagnostics, initialise, loops, rotation, shutter, zoom
from stages.ba.classify import Statistics
from stages.ba.first_focal import focals_of_part
from stages.ba.graph import MIN_MATCHES, FlowGraph, shared_matches, thin_graph, without_loops
from stages.ba.guesses import Observed
from stages.ba.initialise import Candidate
from stages.ba.options import BAOptions
from stages.ba.problem import Estimate, Focal, Problem
from stages.ba.refinement import BLIND_FOCAL, FINE_PX, WEAK_FOCAL, refine
from stages.ba.start import COARSE_PIXELS, Start, find_start
from stages.ba.state import FocalPrior, State, Step, Unknowns
from stages.ba.uncertainty import focal_sigma, median_residual, solution_covariance
from stages.ba.zoom import NOT_TESTED, Evidence

PRIOR_FOCAL = 1.1
"""Centre of the focal length prior, in image widths (a horizontal field of view of 49 degrees)."""

CORRECTIONS = 2
"""Corrections of the matches for a rolling shutter, each from a better solution than the one before."""


def estimate(problem: Problem, options: BAOptions) -> Estimate:
    """Solve for poses, inverse depths and focal length. A failure is also returned, with its reason in `flags`.

    If the solution with masks fails checks and that without masks fails fewer, the masks are ignored: wrong masks do
    more harm than movers, which the robust kernel downweights in part.
    """
    solution = _best(problem, options)
    return replace(solution, flags=solution.flags + diagnostics.of_options(solution, options))


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
    graph = problem.graph
    prior = FocalPrior(PRIOR_FOCAL * graph.width)
    focals = [problem.known_focal_px] if problem.known_focal_px else [f * graph.width for f in options.start_focals]
    if not _observed(graph):
        return _failure(graph, problem.known_focal_px or prior.focal_px)
    statistics = classify.measure(graph, problem.known_focal_px, options.seed)
    if statistics.camera == "rotating":
        rotations = _estimate_rotations(problem, statistics, prior, options)
        if rotations.failed_checks:
            focal_px = rotations.state.focal_px
            statistics = classify.measure(graph, focal_px, options.seed, classify.longest_step(graph))
        if statistics.camera == "rotating":
            return rotations
    turning = None
    if statistics.planar and options.zoom != "no" and not problem.known_focal_px:
        turning = _estimate_turning_zoom(problem, statistics, prior)
        if turning.zoom.decision == "changing":
            return turning
    start = _start(problem, statistics, prior, focals, options)
    graph = start.graph
    problem = replace(problem, graph=graph, masked=problem.masked or start.static is not None)
    found = start.candidate
    cameras = found.state
    state = initialise.initial_state(graph, cameras.cam_from_world, cameras.focal_px, FINE_PX[0], cameras.zoom)
    free = not problem.known_focal_px and statistics.camera == "moving"
    closed = loops.close(graph, state, Unknowns(free, zoom=free and state.zoom is not None), prior)
    graph, problem = closed.graph, replace(problem, graph=closed.graph)
    refined, focal = refine(problem, statistics, replace(found, state=closed.state), prior)
    near_still = statistics.camera == "near-still"
    rolling = _rolling(graph, refined.state, focal, prior, options, may_assume=not near_still)
    evidence = start.zoom or NOT_TESTED
    if rolling.decision == "rolling" and evidence.decision == "changing" and options.zoom == "auto":
        beside, with_one = _with_one_focal(problem, statistics, refined, prior, options)
        if beside.decision != "changing":
            evidence, (refined, focal, rolling) = beside, with_one
    if rolling.decision == "rolling":
        turned = classify.measure(
            shutter.correct(graph, refined.state, rolling.readout), problem.known_focal_px, options.seed
        )
        if turned.camera == "rotating":  # rows at different times look like parallax
            rotations = _estimate_rotations(problem, turned, prior, options)
            if not rotations.failed_checks:
                return rotations
        for _ in range(CORRECTIONS):
            problem = replace(problem, graph=shutter.correct(graph, refined.state, rolling.readout))
            refined, focal = refine(problem, statistics, refined, prior)
        graph = problem.graph
    residual_px = median_residual(graph, refined.state)
    against = diagnostics.of_solution(replace(found, state=refined.state), start.others, statistics, residual_px)
    steps = [step for candidate in (*start.others, found) for step in candidate.steps] + closed.steps + refined.steps
    solution = _finish(problem, statistics, refined.state, focal, against, steps)
    numbers = solution.statistics | {"roughness": found.roughness} | closed.facts
    solution = replace(solution, static=start.static, statistics=numbers, flags=start.flags + solution.flags)
    if turning and turning.zoom.decision == "not observable" and refined.state.zoom is None:
        evidence = turning.zoom
    flags = solution.flags + diagnostics.of_zoom(evidence) + diagnostics.of_shutter(rolling)
    return replace(solution, zoom=evidence, rolling=rolling, flags=flags)


def _with_one_focal(
    problem: Problem, statistics: Statistics, changing: Candidate, prior: FocalPrior, options: BAOptions
) -> tuple[Evidence, tuple[Candidate, Focal, shutter.Evidence]]:
    """The decision about a changing focal length again, beside a rolling shutter, which imitates one.

    A camera that tilts while the rows are exposed shows a picture that is taller or less tall. Also the cameras with
    one focal length, without the shutter, and their own evidence for it.
    """
    graph, one = problem.graph, replace(changing, state=replace(changing.state, zoom=None))
    one, focal = refine(problem, statistics, one, prior)
    rolling = _rolling(graph, one.state, focal, prior, options)
    factor = max(1, int(np.sqrt(len(graph.pixels) / COARSE_PIXELS)))
    coarse = thin_graph(without_loops(shutter.correct(graph, one.state, rolling.readout)), factor)
    fixed, other = (shutter.resampled(found.state, graph, coarse) for found in (one, changing))
    density = len(coarse.pixels) / len(graph.pixels)
    return zoom.weigh(coarse, fixed, lambda: [other], prior, density)[0], (one, focal, rolling)


def _rolling(
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


def _start(
    problem: Problem, statistics: Statistics, prior: FocalPrior, focals: list[float], options: BAOptions
) -> Start:
    """The best initialisation of the camera path; a camera that hardly moves does not determine a focal length."""
    previous = problem.previous
    if previous:
        previous = replace(previous, focal_px=problem.known_focal_px or previous.focal_px)
        focals = [previous.focal_px]
    elif statistics.camera == "near-still" and not problem.known_focal_px:
        focals = [prior.focal_px]
    unmasked = problem.unmasked or problem.graph
    observed = Observed(problem.graph, unmasked, previous, focals, statistics, prior, options.seed)
    free = statistics.camera == "moving" and not problem.known_focal_px
    if free and not previous:
        observed = replace(observed, focals_px=focals_of_part(observed))
    tested = free and options.zoom != "no"
    return find_start(replace(observed, masked=problem.masked, free=free, tested=tested, assumed=options.zoom == "yes"))


def _estimate_rotations(problem: Problem, statistics: Statistics, prior: FocalPrior, options: BAOptions) -> Estimate:
    graph = problem.graph
    state, steps = rotation.solve_rotations(graph, prior, problem.known_focal_px)
    known = Focal("known", 0.0) if problem.known_focal_px else None
    rolling = _rolling(graph, state, known or Focal("estimated", None), prior, options, translation=False)
    if rolling.decision == "rolling":
        for _ in range(CORRECTIONS):
            graph = shutter.correct(problem.graph, state, rolling.readout)
            state, steps = rotation.solve_rotations(graph, prior, problem.known_focal_px)
    sigma = focal_sigma(graph, state, translation=False)
    focal = known or Focal("weakly observed" if sigma > WEAK_FOCAL else "estimated", sigma)
    against = diagnostics.of_rotations(graph, dba.errors_px(graph, state))
    solution = _finish(replace(problem, graph=graph), statistics, state, focal, against, steps)
    return replace(solution, rolling=rolling, flags=solution.flags + diagnostics.of_shutter(rolling))


def _estimate_turning_zoom(problem: Problem, statistics: Statistics, prior: FocalPrior) -> Estimate:
    """The solution as a camera that turns and zooms; its decision is "constant" if that does not explain the flow."""
    graph = problem.graph
    state, steps = rotation.solve_rotations(graph, prior, None, zoom=True)
    sigma = focal_sigma(graph, state, translation=False)
    focal = Focal("weakly observed" if sigma > WEAK_FOCAL else "estimated", sigma)
    against = diagnostics.of_rotations(graph, dba.errors_px(graph, state))
    residual_px = median_residual(graph, state)
    turning = replace(statistics, rotation_1_px=residual_px, rotation_px=residual_px)
    solution = _finish(problem, turning, state, focal, against, steps)
    noise_px = max(statistics.sampson_px, classify.FLOOR_PX)
    evidence = zoom.of_turning(graph, state, noise_px)
    if against or turning.camera != "rotating" or (evidence.decision == "changing" and sigma > BLIND_FOCAL):
        evidence = Evidence("constant", "a camera that turns and zooms does not explain the flow")
    return replace(solution, zoom=evidence)


def _observed(graph: FlowGraph) -> bool:
    """Whether most pairs of neighbouring frames share at least MIN_MATCHES sure matches."""
    shared = shared_matches(graph.source, graph.target, graph.weights, graph.T)
    return bool(np.median(np.diagonal(shared, 1)) >= MIN_MATCHES)


def _failure(graph: FlowGraph, focal_px: float) -> Estimate:
    T = graph.T
    state = State(np.tile(np.eye(4), (T, 1, 1)), np.ones((T, len(graph.pixels))), focal_px)
    reason = "failed: neighbouring frames share too few confident static matches; the poses are the identity"
    focal = asdict(Focal("held at prior", None, "nothing could be estimated")) | {"focal_px": focal_px}
    return Estimate(state, "failed", np.zeros((T, 6, 6)), float("inf"), focal, {}, [reason], [reason])


def _finish(
    problem: Problem, statistics: Statistics, state: State, focal: Focal, against: list[str], steps: list[Step]
) -> Estimate:
    graph = problem.graph
    free = focal.decision in ("estimated", "weakly observed")
    unknowns = Unknowns(free, statistics.camera != "rotating", free and state.zoom is not None)
    covariance = checkpoint.array(lambda: solution_covariance(graph, state, unknowns).poses(graph.T))
    decision = asdict(focal) | {"focal_px": state.focal_px}
    flags = list(against)
    if statistics.planar:
        flags.append("planar scene: one homography explains the flow, so that depth and motion rest on one plane")
    flags += diagnostics.of_focal(statistics.camera, decision)
    if statistics.camera != "rotating":
        flags += diagnostics.of_path(state.cam_from_world, covariance)
    numbers = asdict(statistics) | {"camera": statistics.camera, "planar": statistics.planar}
    residual_px = median_residual(graph, state)
    return Estimate(state, statistics.camera, covariance, residual_px, decision, numbers, against, flags, steps)
