"""Dense bundle adjustment: Levenberg-Marquardt on a graduated Geman-McClure cost; steps that raise it are rejected."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from stages.ba import checkpoint, residuals
from stages.ba.arguments import geometry, lens_px, observations, undistorted
from stages.ba.graph import FlowGraph
from stages.ba.proposal import DENSE_FRAMES, from_prior, propose
from stages.ba.state import (
    DEPTH_PRIOR,
    INVERSE_DEPTHS,
    LENS_PRIOR,
    FocalPrior,
    Level,
    State,
    Step,
    Unknowns,
    prior_share,
)
from stages.shared import lie
from stages.shared.log import logger

REFINEMENTS = 2
"""Gauss-Newton steps from every candidate of a sweep for inverse depths."""
MAX_DAMPING = 1e4
DAMPING, DAMPING_OF_LONG = (1e-3, 5.0, 1e-7), (1e-7, 10.0, 1e-12)
"""The first damping, what it is divided by after a step that is taken, and its least value; of more than DENSE_FRAMES.

The curvature of the slow bends of a path falls with the fourth power of its length. A chain of 1000 frames with
an error of 3.2 % of its length had 2.7 % left after eight steps with (1e-3, 3.0), and 1.6 % after three with these.
"""
GAIN_OF_LONG = 5e-4
"""Least relative gain of a step over more than DENSE_FRAMES frames: slow bends do not wait for damping to fall."""


def normalise(state: State) -> State:
    """The same solution in the gauge: first pose identity, median inverse depth (which must be positive) 1."""
    scale = float(np.median(state.inverse_depth))
    cam_from_world = state.cam_from_world @ lie.inverse(state.cam_from_world[0])
    cam_from_world[:, :3, 3] *= scale
    return replace(state, cam_from_world=cam_from_world, inverse_depth=state.inverse_depth / scale)


def errors_px(graph: FlowGraph, state: State) -> np.ndarray:
    """Reprojection errors of the matches [E, P] float32 in px (1e6 behind the camera)."""
    data, at = observations(graph, state.lens), geometry(graph, state)
    return np.asarray(residuals.errors_px(data, at, lens_px(graph, state)))


def robust_cost(graph: FlowGraph, errors: np.ndarray, sigma_px: float) -> float:
    """Mean Geman-McClure cost in px^2 of errors [E, P], weighted; 0 without any weight."""
    ratio = (errors / np.float32(sigma_px)) ** 2
    total = float((graph.weights * (ratio / (1 + ratio))).sum(dtype=float))
    return sigma_px**2 * total / max(float(graph.weights.sum(dtype=float)), 1e-12)


def fitting_pixels(graph: FlowGraph, errors: np.ndarray, sigma_px: float, share: float) -> np.ndarray:
    """Which pixels [T, P] have at least `share` inliers, by weight, among their matches with errors [E, P].

    An error counts as inlier by its robust weight at the scale `sigma_px`. A pixel without matches fits.
    """
    fits = graph.weights / (1 + (errors / np.float32(sigma_px)) ** 2) ** 2
    fitting, total = np.zeros((2, graph.T, len(graph.pixels)))
    np.add.at(fitting, graph.source, fits)
    np.add.at(total, graph.source, graph.weights)
    return np.asarray(fitting >= share * total)


def sweep(graph: FlowGraph, state: State, candidates: np.ndarray, sigma_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Best inverse depth [T, P] and its curvature [T, P] (px^2) with the poses fixed, from `candidates` [K, T, P].

    Behind a lens the residuals are those of the undistorted image.
    """
    data, at = observations(graph, state.lens), geometry(graph, state)
    if state.lens is not None:
        data = data._replace(matches=undistorted(graph, state.lens, graph.matches).astype(np.float32))
    best, curvature = residuals.sweep_depth(data, at, float(sigma_px), candidates, REFINEMENTS, *INVERSE_DEPTHS)
    return best, curvature


def solve(
    graph: FlowGraph,
    state: State,
    schedule: Sequence[Level],
    unknowns: Unknowns,
    prior: FocalPrior,
    phase: str,
) -> tuple[State, list[Step]]:
    """Minimise the robust reprojection cost, level after level, starting from `state`.

    Returns:
        the best state, in the gauge of `State`, and one `Step` per iteration.
    """
    long = graph.T > DENSE_FRAMES
    first, relief, least = DAMPING_OF_LONG if long else DAMPING
    run = _Run(normalise(state) if unknowns.translation else state, first)
    before = checkpoint.begin()
    if before is not None:
        run = _restored(*before)
        if before[1].get("finished"):
            return run.state, run.steps
    for number, level in enumerate(schedule):
        if number < run.level:
            continue
        cost = _objective(graph, run.state, level.sigma_px, unknowns, prior)
        enough = max(level.gain, GAIN_OF_LONG) if long else level.gain
        while run.iteration < level.iterations:
            start_s = time.perf_counter()
            proposal, size = propose(graph, run.state, level.sigma_px, run.damping, unknowns, prior)
            proposed = _objective(graph, proposal, level.sigma_px, unknowns, prior) if proposal else np.inf
            accepted = proposal is not None and proposed <= cost
            gain = (cost - proposed) / max(cost, 1e-300)
            if accepted and proposal:
                run.state, cost, run.damping = proposal, proposed, max(run.damping / relief, least)
            else:
                run.damping *= 8
            seconds, focal_px = time.perf_counter() - start_s, run.state.focal_px
            run.steps.append(Step(phase, level.sigma_px, cost, size, run.damping, focal_px, accepted, seconds))
            run.iteration += 1
            if long:
                _tell(phase, schedule, number, run.iteration)
            if (accepted and gain < enough) or run.damping > MAX_DAMPING:
                break
            checkpoint.save_sometimes(run.capture)
        run.level, run.iteration = number + 1, 0
    if unknowns.translation:
        run.state = normalise(run.state)
    checkpoint.finished(run.capture)
    return run.state, run.steps


def _tell(phase: str, schedule: Sequence[Level], number: int, iteration: int) -> None:
    """A line of progress after an iteration of the level `number`; levels that end early count as whole ones."""
    counts = [level.iterations for level in schedule]
    logger.info("adjusting, %s: %d of %d", phase, sum(counts[:number]) + iteration, sum(counts))


@dataclass
class _Run:
    """A solve under way: its state, damping and steps; the level it is at, and the iterations done there."""

    state: State
    damping: float
    level: int = 0
    iteration: int = 0
    steps: list[Step] = field(default_factory=list)

    def capture(self) -> checkpoint.Kept:
        """What a checkpoint keeps of it."""
        about = {"damping": self.damping, "level": self.level, "iteration": self.iteration}
        return checkpoint.arrays_of(self.state), about | {"steps": [asdict(step) for step in self.steps]}


def _restored(arrays: Mapping[str, np.ndarray], about: Mapping[str, Any]) -> _Run:
    steps = [Step(**step) for step in about["steps"]]
    return _Run(checkpoint.state_of(arrays), about["damping"], about["level"], about["iteration"], steps)


def _objective(graph: FlowGraph, state: State, sigma_px: float, unknowns: Unknowns, prior: FocalPrior) -> float:
    """Objective of Levenberg-Marquardt: data, depth prior and focal prior, per unit of weight, px^2."""
    total_weight = max(float(graph.weights.sum(dtype=float)), 1e-12)
    cost = robust_cost(graph, errors_px(graph, state), sigma_px)
    if unknowns.translation:
        cost += prior_share(sigma_px) * DEPTH_PRIOR * float(((state.inverse_depth - 1) ** 2).sum()) / total_weight
    if unknowns.focal:
        cost += prior.at(sigma_px).cost(from_prior(state, unknowns, prior)) / total_weight
    if state.lens is not None:
        cost += LENS_PRIOR * float(state.lens @ state.lens) / total_weight
    return cost
