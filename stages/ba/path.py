"""The solution with a camera path: start, loops, refinement, a rolling shutter, and what speaks against it."""

from dataclasses import dataclass, replace

from stages.ba import classify, diagnostics, initialise, loops, shutter, zoom
from stages.ba.classify import Statistics
from stages.ba.first_focal import focals_of_part
from stages.ba.graph import thin_graph, thinning, without_loops
from stages.ba.guesses import Observed
from stages.ba.initialise import Candidate
from stages.ba.loops import Closed
from stages.ba.options import BAOptions
from stages.ba.problem import Estimate, Focal, Problem
from stages.ba.refinement import FINE_PX, refine
from stages.ba.solution import CORRECTIONS, finish, rolling_evidence
from stages.ba.start import COARSE_PIXELS, Start, find_start
from stages.ba.state import FocalPrior, Unknowns
from stages.ba.turning import estimate_rotations
from stages.ba.uncertainty import median_residual
from stages.ba.zoom import NOT_TESTED, Evidence


@dataclass(frozen=True)
class Refined:
    """Cameras after the refinement, with the decisions about focal length, zoom and shutter."""

    cameras: Candidate
    focal: Focal
    zoom: Evidence
    rolling: shutter.Evidence


def estimate_path(
    problem: Problem, statistics: Statistics, prior: FocalPrior, options: BAOptions, turning: Evidence | None
) -> Estimate:
    """The solution for a camera that moves, or hardly moves, by `statistics`.

    A camera whose rows are exposed one after the other, and which only turns once that is corrected, is solved so.

    Args:
        turning: evidence of a camera that turns and zooms, where it was asked for.
    """
    start = _start(problem, statistics, prior, options)
    prior = replace(prior, focal_px=start.focal_px or prior.focal_px)
    closed = _closed(problem, start, prior)
    problem = replace(problem, graph=closed.graph, masked=problem.masked or start.static is not None)
    refined = _refined(problem, start, closed, statistics, prior, options)
    if refined.rolling.decision == "rolling":
        rotations = _turning_rows(problem, refined, prior, options)
        if rotations and not rotations.failed_checks:
            return rotations
        problem, refined = _corrected(problem, statistics.camera, refined, prior)
    found, state = start.candidate, refined.cameras.state
    residual_px = median_residual(problem.graph, state)
    against = diagnostics.of_solution(replace(found, state=state), start.others, statistics, residual_px)
    steps = [step for candidate in (*start.others, found) for step in candidate.steps]
    steps += closed.steps + refined.cameras.steps
    moved_px = start.focal_px or (problem.previous and problem.previous.prior_px)
    focal = replace(refined.focal, prior_sides=moved_px / problem.graph.long_side_px) if moved_px else refined.focal
    solution = finish(problem, statistics, state, focal, against, steps)
    numbers = solution.statistics | {"roughness": found.roughness} | closed.facts
    evidence = refined.zoom
    if turning and turning.decision == "not observable" and state.zoom is None:
        evidence = turning
    flags = start.flags + solution.flags + diagnostics.of_zoom(evidence) + diagnostics.of_shutter(refined.rolling)
    solution = replace(solution, static=start.static, statistics=numbers, flags=flags)
    return replace(solution, zoom=evidence, rolling=refined.rolling)


def _start(problem: Problem, statistics: Statistics, prior: FocalPrior, options: BAOptions) -> Start:
    """The best initialisation of the camera path; a zoom is looked for only where the camera moves."""
    known, side_px = problem.known_focal_px, problem.graph.long_side_px
    focals = [known] if known else [focal * side_px for focal in options.start_focals]
    previous = problem.previous
    if previous:
        previous = replace(previous, focal_px=known or previous.focal_px)
        focals = [previous.focal_px]
    unmasked = problem.unmasked or problem.graph
    observed = Observed(problem.graph, unmasked, previous, focals, statistics, prior, options.seed)
    free, moves = not known, statistics.camera == "moving"
    if free and not previous:
        observed = replace(observed, focals_px=focals_of_part(observed))
    tested = free and moves and options.zoom != "no"
    return find_start(replace(observed, masked=problem.masked, free=free, tested=tested, assumed=options.zoom == "yes"))


def _closed(problem: Problem, start: Start, prior: FocalPrior) -> Closed:
    """The graph of the start with its loops, and the cameras to refine."""
    graph, cameras = start.graph, start.candidate.state
    state = initialise.initial_state(graph, cameras.cam_from_world, cameras.focal_px, FINE_PX[0], cameras.zoom)
    free = not problem.known_focal_px
    return loops.close(graph, state, Unknowns(free, zoom=free and state.zoom is not None), prior)


def _refined(
    problem: Problem, start: Start, closed: Closed, statistics: Statistics, prior: FocalPrior, options: BAOptions
) -> Refined:
    """The cameras, with what they say of a rolling shutter, and of a zoom once more beside it."""
    cameras, focal = refine(problem, statistics.camera, replace(start.candidate, state=closed.state), prior)
    may_assume = statistics.camera != "near-still"
    rolling = rolling_evidence(problem.graph, cameras.state, focal, prior, options, may_assume=may_assume)
    found = Refined(cameras, focal, start.zoom or NOT_TESTED, rolling)
    if rolling.decision == "rolling" and found.zoom.decision == "changing" and options.zoom == "auto":
        with_one = _with_one_focal(problem, statistics.camera, cameras, prior, options)
        return found if with_one.zoom.decision == "changing" else with_one
    return found


def _with_one_focal(
    problem: Problem, camera: str, changing: Candidate, prior: FocalPrior, options: BAOptions
) -> Refined:
    """Cameras with one focal length, without the shutter, their own evidence for it, and beside it that of a zoom.

    A rolling shutter imitates a zoom: a camera that tilts while the rows are exposed shows a picture that is taller or
    less tall.
    """
    graph, one = problem.graph, replace(changing, state=replace(changing.state, zoom=None))
    one, focal = refine(problem, camera, one, prior)
    rolling = rolling_evidence(graph, one.state, focal, prior, options)
    factor = thinning(graph, COARSE_PIXELS)
    coarse = thin_graph(without_loops(shutter.correct(graph, one.state, rolling.readout)), factor)
    fixed, other = (shutter.resampled(found.state, graph, coarse) for found in (one, changing))
    density = len(coarse.pixels) / len(graph.pixels)
    return Refined(one, focal, zoom.weigh(coarse, fixed, lambda: [other], prior, density)[0], rolling)


def _turning_rows(problem: Problem, refined: Refined, prior: FocalPrior, options: BAOptions) -> Estimate | None:
    """Rotations, if they explain the corrected matches: rows at different times look like parallax."""
    graph = shutter.correct(problem.graph, refined.cameras.state, refined.rolling.readout)
    turned = classify.measure(graph, problem.known_focal_px, options.seed)
    return estimate_rotations(problem, turned, prior, options) if turned.camera == "rotating" else None


def _corrected(problem: Problem, camera: str, refined: Refined, prior: FocalPrior) -> tuple[Problem, Refined]:
    """The problem with matches as if all rows were exposed at once, and its solution."""
    graph = problem.graph
    for _ in range(CORRECTIONS):
        problem = replace(problem, graph=shutter.correct(graph, refined.cameras.state, refined.rolling.readout))
        cameras, focal = refine(problem, camera, refined.cameras, prior)
        refined = replace(refined, cameras=cameras, focal=focal)
    return problem, refined
