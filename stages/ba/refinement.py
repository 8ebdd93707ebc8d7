"""The refined solution: a sharp kernel, movers trimmed, and whether the focal length is free."""

from dataclasses import replace

import numpy as np

from stages.ba import dba, initialise, trim
from stages.ba.graph import FlowGraph
from stages.ba.initialise import Candidate
from stages.ba.problem import Focal, Problem
from stages.ba.state import FocalPrior, Level, State, Unknowns
from stages.ba.uncertainty import focal_sigma, median_residual
from stages.ba.weights import favour_distance

UNUSUAL_FOCAL = 1.5
"""A focal length further than this factor from the prior's centre needs masks that were made with cameras."""
WEAK_FOCAL, BLIND_FOCAL = 0.05, 0.15
"""Predicted relative error above which the focal length is called weakly observed, and is not estimated at all."""
CONSISTENT_SHARE = 0.85
"""If this share of the confident matches fits a static scene to 1 px, the focal length is free without masks."""
FINE_PX = (1.0, 0.5)
"""Robust scales of the refinement in px, before the last one."""
SHARP, SHARP_PX = 2.0, (0.05, 0.5)
"""The last robust scale in units of the median residual, and its limits in px."""


def refine(problem: Problem, camera: str, start: Candidate, prior: FocalPrior) -> tuple[Candidate, Focal]:
    """The refined start. The focal length is free where masks or a consistent static scene allow it.

    However little the camera moves, an estimate is kept where its predicted error is at most BLIND_FOCAL. Without masks
    that of such a `camera` is not: flow below a pixel is consistent with any static scene, and a slow mover drags it.
    """
    graph = problem.graph
    reason = _reason_to_hold(problem, camera, start.state)
    if not reason:
        refined = _adjust(problem, start.state, Unknowns(focal=True, zoom=start.state.zoom is not None), prior)
        sigma = focal_sigma(graph, refined.state)
        reason = _reason_to_drop(problem, refined.state.focal_px / prior.focal_px, sigma)
        if not reason:
            return refined, Focal("weakly observed" if sigma > WEAK_FOCAL else "estimated", sigma)
    if problem.known_focal_px:
        return _adjust(problem, start.state, Unknowns(), prior), Focal("known", 0.0)
    held = replace(start.state, focal_px=prior.focal_px)
    refined = _adjust(problem, held, Unknowns(), prior)
    return refined, Focal("held at prior", focal_sigma(graph, refined.state), reason)


def consistent_share(graph: FlowGraph, state: State) -> float:
    """Share of the matches, by weight, that fit a static scene to 1 px."""
    return float(graph.weights[dba.errors_px(graph, state) < 1.0].sum() / graph.weights.sum())


def _reason_to_hold(problem: Problem, camera: str, state: State) -> str:
    """The reason to hold the focal length fixed, in words; empty if it may be free."""
    if problem.known_focal_px:
        return "it is known"
    if not problem.masked and camera == "near-still":
        return "the camera hardly moves, and there are no masks"
    consistent = consistent_share(problem.graph, state)
    if not problem.masked and consistent < CONSISTENT_SHARE:
        return f"there are no masks yet and only {100 * consistent:.0f} % of the matches fit a static scene"
    return ""


def _reason_to_drop(problem: Problem, ratio: float, sigma: float) -> str:
    """The reason to reject an estimated focal length, `ratio` times the prior's, in words; empty to accept it."""
    if sigma > BLIND_FOCAL:
        return f"its predicted error is {f'{100 * sigma:.0f}' if sigma < 1 else 'more than 100'} %"
    if problem.masked and problem.previous is None and max(ratio, 1 / ratio) > UNUSUAL_FOCAL:
        # Masks from flow alone miss the motion of a large mover along epipolar lines, which biases the focal length.
        return f"it came out {ratio:.1f} times the prior's, with masks from flow alone"
    return ""


def _adjust(problem: Problem, state: State, unknowns: Unknowns, prior: FocalPrior) -> Candidate:
    """The state refined, then trimmed of large movers that the masks miss in part."""
    adjusted = _adjust_twice(problem, state, unknowns, prior)
    unmasked = problem.unmasked or problem.graph
    masked_share = float(1 - problem.graph.weights.sum() / unmasked.weights.sum())
    sigma_px = float(np.clip(SHARP * median_residual(problem.graph, adjusted.state), *SHARP_PX))
    return trim.concentrate(problem.graph, masked_share, adjusted, sigma_px, unknowns, prior)


def _adjust_twice(problem: Problem, state: State, unknowns: Unknowns, prior: FocalPrior) -> Candidate:
    """The state refined, then again at the scale of the noise with new depths: some were in wrong local minima.

    A kernel as narrow as the noise rejects the biased flow along edges and repeated texture. Edges between distant
    frames weigh more: flow errors hardly grow with the distance, and errors common to all edges add up along a chain
    of short ones.
    """
    graph, fine = problem.graph, [Level(sigma_px, problem.iterations) for sigma_px in FINE_PX]
    first = initialise.adjust(graph, state, fine, unknowns, prior, "refinement")
    searched = initialise.search_depth(graph, first.state, FINE_PX[-1])
    sigma_px = float(np.clip(SHARP * median_residual(graph, first.state), *SHARP_PX))
    sharp = (Level(sigma_px, problem.iterations),)
    again = initialise.adjust(favour_distance(graph), searched, sharp, unknowns, prior, "refinement, sharp")
    return replace(again, steps=first.steps + again.steps)
