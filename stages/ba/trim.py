"""Trimmed adjustment to inliers at the scale of the noise, where large movers are only partly masked.

A rigid mover that fills much of the frame biases cameras and focal length until mover and static world both fit
roughly, at a lower cost than the true solution at any robust scale wider than the noise. At the scale of the noise the
true solution costs less, but no adjustment reaches it from the biased one, whose kernel covers both motions. Leaving
out the outliers at that scale resolves this (least trimmed squares: Rousseeuw and Van Driessen, 2006, "concentration
steps").
"""

from dataclasses import replace

import numpy as np

from stages.ba import dba, initialise
from stages.ba.graph import FlowGraph
from stages.ba.initialise import Candidate
from stages.ba.state import FocalPrior, Level, State, Step, Unknowns
from stages.ba.weights import favour_distance

LARGE = 0.2
"""Share of the matches, by weight, that masks must remove before movers are large enough to bias the cameras."""
STEPS = 6
SETTLED = 1e-3
"""Relative change of the cost below which the steps have converged."""
SCALES, ITERATIONS = (4.0, 1.5), 10
"""Robust scales of a step, in units of the noise, and the iterations at each."""
AGREEING = 0.6
"""Share of its matches, by weight, that must be inliers for a pixel to be kept."""
GAIN = 0.02
"""Relative decrease of the cost of all pixels that a trimmed solution needs to be accepted: less may be chance."""


def concentrate(
    graph: FlowGraph, masked_share: float, start: Candidate, sigma_px: float, unknowns: Unknowns, prior: FocalPrior
) -> Candidate:
    """The start, or the best of a few steps that leave out the outliers at `sigma_px`, the scale of the noise.

    The best has the lowest robust cost over all observations of `graph`, so leaving out outliers does not lower it by
    itself. Where masks remove little, the start is returned unchanged.
    """
    if masked_share < LARGE:
        return start
    cost = _cost(graph, start.state, sigma_px)
    lowest, best, state, steps = (1 - GAIN) * cost, start, start.state, list(start.steps)
    for _ in range(STEPS):
        trimmed = _step(graph, state, sigma_px, unknowns, prior)
        state, before = trimmed.state, cost
        steps += trimmed.steps
        cost = _cost(graph, state, sigma_px)
        if cost < lowest:
            best, lowest = replace(trimmed, state=initialise.search_depth(graph, state, sigma_px)), cost
        if abs(cost - before) < SETTLED * before:
            break
    return replace(best, steps=steps)


def _step(graph: FlowGraph, state: State, sigma_px: float, unknowns: Unknowns, prior: FocalPrior) -> Candidate:
    """The state adjusted to the observations of the pixels that fit."""
    kept = _fitting(graph, state, sigma_px)
    part = replace(graph, weights=graph.weights * kept[graph.source])
    steps: list[Step] = []
    for scale in SCALES:
        state = initialise.search_depth(part, state, scale * sigma_px)
        levels = (Level(scale * sigma_px, ITERATIONS),)
        adjusted = initialise.adjust(favour_distance(part), state, levels, unknowns, prior, "refinement, trimmed")
        state, steps = adjusted.state, steps + adjusted.steps
    return replace(adjusted, steps=steps)


def _cost(graph: FlowGraph, state: State, sigma_px: float) -> float:
    """Robust cost of all observations, each pixel at its best depth."""
    searched = initialise.search_depth(graph, state, sigma_px)
    return dba.robust_cost(graph, dba.errors_px(graph, searched), sigma_px)


def _fitting(graph: FlowGraph, state: State, sigma_px: float) -> np.ndarray:
    """Which pixels [T, P] fit the state at some depth."""
    errors = dba.errors_px(graph, initialise.search_depth(graph, state, sigma_px))
    return dba.fitting_pixels(graph, errors, sigma_px, AGREEING)
