"""Guesses of the camera path: the previous solution, and those from the matches, adjusted on a coarse grid."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stages.ba import initialise, planar
from stages.ba.classify import Statistics, longest_step
from stages.ba.graph import FlowGraph
from stages.ba.initialise import Candidate, Hypothesis
from stages.ba.proposal import DENSE_FRAMES
from stages.ba.state import FocalPrior, Level, State, Unknowns

MAX_PAIR_PX = 0.3
"""Largest threshold of two-view fits: with a wider one, movers count as inliers."""
ENOUGH, ENOUGH_OF_LONG = 1e-3, 1e-2
"""Relative gain below which a guess is adjusted no further: costs of guesses differ by much more. Of more than
DENSE_FRAMES frames the second is enough: their slow bends are gone after three steps (`stages.ba.dba.DAMPING_OF_LONG`).
"""
FAR_BEHIND = 2.0
"""A guess with this many times the lowest cost at the wide scale is not tried at the narrow one."""


@dataclass(frozen=True)
class PoseGuess:
    """An initial guess: poses [T, 4, 4] of any scale; focal length, px of the flow grid, and zoom as in `state.State`.

    `alone`: it is the only guess, without those from the matches. `prior_px`: where the round before has moved the
    centre of the prior of the focal length to.
    """

    cam_from_world: np.ndarray
    focal_px: float
    zoom: np.ndarray | None = None
    alone: bool = False
    prior_px: float | None = None


@dataclass(frozen=True)
class Observed:
    """Input of the initialisation.

    Attributes:
        graph: masked observations; unmasked: the same without masks (the same object if there are none).
        previous: the solution of the previous round.
        focals_px: focal lengths to try; curve: the zoom to try them with, as in `state.State`.
        masked: as in `problem.Problem`. free: whether the focal length is to be found; tested: whether a changing one
            is tried besides; assumed: whether that is taken without a test.
    """

    graph: FlowGraph
    unmasked: FlowGraph
    previous: PoseGuess | None
    focals_px: Sequence[float]
    statistics: Statistics
    prior: FocalPrior
    seed: int
    curve: np.ndarray | None = None
    masked: bool = False
    free: bool = False
    tested: bool = False
    assumed: bool = False

    @property
    def threshold_px(self) -> float:
        """Robust scale of the first adjustment: flow errors grow with the flow."""
        return float(np.clip(0.15 * self.statistics.flow_px, 0.3, 1.0))


def guess(observed: Observed, graph: FlowGraph) -> list[Candidate]:
    """Adjusted guesses on one graph: the previous solution, and those from the matches unless it is to be alone."""
    previous = observed.previous
    poses_of: dict[str, tuple[np.ndarray, float]] = {}
    if previous:
        name = "given poses" if previous.alone else "previous round"
        poses_of[name] = previous.cam_from_world, previous.focal_px
    if previous is None or not previous.alone:
        poses_of |= _from_matches(observed, graph)
    states = {
        name: initialise.initial_state(graph, *guessed, zoom=observed.curve) for name, guessed in poses_of.items()
    }
    return adjust_guesses(graph, states, observed.threshold_px, observed.prior)


def _from_matches(observed: Observed, graph: FlowGraph) -> dict[str, tuple[np.ndarray, float]]:
    """Poses and focal lengths of guesses from matches, by name: chains over focal lengths and steps, and planes."""
    threshold_px, curve = observed.threshold_px, observed.curve
    poses_of = {}
    steps = sorted({1, longest_step(graph)})
    planes = planar.homographies(graph) if observed.statistics.dominant_plane else None
    for focal_px in observed.focals_px:
        at = f"at {focal_px / graph.long_side_px:.2f} longer sides"
        for step in steps:
            hypothesis = Hypothesis(focal_px, min(threshold_px / 2, MAX_PAIR_PX), step, curve)
            poses = initialise.chain(graph, hypothesis, observed.seed)
            poses_of[f"chain {at}, {step} frames apart"] = poses, focal_px
        if planes:
            poses = planar.chain_planes(planes, focal_px if curve is None else focal_px * curve)
            poses_of[f"plane {at}"] = poses, focal_px
    return poses_of


def adjust_guesses(
    graph: FlowGraph, states: Mapping[str, State], sigma_px: float, prior: FocalPrior
) -> list[Candidate]:
    """Guesses adjusted in two levels, down to a scale of `sigma_px`; expensive ones are dropped after the first."""

    enough = ENOUGH if graph.T <= DENSE_FRAMES else ENOUGH_OF_LONG

    def adjust(state: State, level: Level, name: str) -> Candidate:
        return initialise.adjust(graph, state, (level,), Unknowns(), prior, name)

    wide = [adjust(state, Level(2 * sigma_px, 6, enough), name) for name, state in states.items()]
    limit = FAR_BEHIND * min(candidate.cost for candidate in wide)
    found = []
    for first in wide:
        if first.cost <= limit:
            narrow = adjust(first.state, Level(sigma_px, 8, enough), first.name)
            found.append(replace(narrow, steps=first.steps + narrow.steps))
    return found
