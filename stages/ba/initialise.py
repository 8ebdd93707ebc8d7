"""Initialisation of poses by chains of two-view motions and of depths for fixed poses; comparison of candidates."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stages.ba import checkpoint, dba, twoview
from stages.ba.graph import MIN_MATCHES, FlowGraph
from stages.ba.state import FocalPrior, Level, State, Step, Unknowns
from stages.shared import lie
from stages.shared.log import progress

SWEEP = np.geomspace(0.02, 10.0, 8)
"""Inverse depths, relative to the median, from which the search for a pixel's depth starts."""
LONG = 200
"""A chain of more pairs than this shows its progress."""
COST_MARGIN = 0.15
"""Among solutions whose cost exceeds the lowest by at most this share, the smoothest is chosen, not the cheapest."""


@dataclass(frozen=True)
class Hypothesis:
    """Parameters of a chain: focal length in px, two-view threshold in px, frame distance of a pair.

    Neighbours match best. Where parallax is small, only distant frames separate camera motion from object motion.
    `zoom` is that of `state.State`.
    """

    focal_px: float
    threshold_px: float
    step: int = 1
    zoom: np.ndarray | None = None

    def focals_px(self, *frames: int) -> list[float]:
        """Focal lengths of these frames."""
        return [self.focal_px * (1.0 if self.zoom is None else float(self.zoom[k])) for k in frames]


@dataclass(frozen=True)
class Candidate:
    """An adjusted hypothesis: robust cost in px^2 and roughness of the camera path, mean |a| / mean |v|."""

    name: str
    state: State
    cost: float
    roughness: float
    steps: list[Step]


def chain(graph: FlowGraph, hypothesis: Hypothesis, seed: int) -> np.ndarray:
    """Camera poses [T, 4, 4] chained from pairs `step` frames apart, or those that the checkpoint has kept."""
    return checkpoint.array(lambda: _chain(graph, hypothesis, seed))


def _chain(graph: FlowGraph, hypothesis: Hypothesis, seed: int) -> np.ndarray:
    """Camera poses [T, 4, 4] chained from pairs `step` frames apart.

    The scale of each pair follows from the frame shared with the pair before: its inverse depths in both pairs differ
    by that scale (weighted median of their log ratio). Frames between are interpolated at constant velocity. A pair
    without a model repeats the velocity of the pair before.
    """
    cam_from_world = np.tile(np.eye(4), (graph.T, 1, 1))
    velocity, scale = np.zeros(6), 1.0
    previous: tuple[int, twoview.TwoView] | None = None
    pairs = pair_chain(graph, hypothesis.step)
    for i, j in progress(pairs, f"pairs {hypothesis.step} apart") if len(pairs) > LONG else pairs:
        focals = hypothesis.focals_px(i, j)
        rays = twoview.pair_rays(graph, i, j, *focals)
        pair = twoview.estimate_motion(*rays, focals[0], hypothesis.threshold_px, seed)
        if pair is not None:
            if previous is not None:
                before, motion = previous
                frames = before, i, j
                scale *= _relative_scale(graph, frames, (motion, pair), hypothesis.focals_px(*frames))
            velocity = lie.log_se3(lie.from_parts(pair.R, scale * pair.t)) / (j - i)
        previous = None if pair is None else (i, pair)
        for frame in range(i + 1, j + 1):
            cam_from_world[frame] = lie.exp_se3((frame - i) * velocity) @ cam_from_world[i]
    return cam_from_world


def pair_chain(graph: FlowGraph, step: int) -> list[tuple[int, int]]:
    """Pairs from the first frame to the last, each of the longest edge length of at most `step` frames."""
    lengths = np.unique(np.abs(graph.target - graph.source))
    pairs, i = [], 0
    while i < graph.T - 1:
        fitting = lengths[lengths <= min(step, graph.T - 1 - i)]
        pairs.append((i, i + int(fitting.max(initial=1))))
        i = pairs[-1][1]
    return pairs


def initial_state(
    graph: FlowGraph,
    cam_from_world: np.ndarray,
    focal_px: float,
    sigma_px: float = 1.0,
    zoom: np.ndarray | None = None,
    lens: np.ndarray | None = None,
) -> State:
    """State in the gauge from cameras alone: inverse depths are searched with the cameras fixed."""
    centres = lie.inverse(cam_from_world)[:, :3, 3]
    reach = float(np.median(np.linalg.norm(np.diff(centres, axis=0), axis=1)))
    near = np.abs(graph.target - graph.source) == 1
    flow_px = np.linalg.norm(graph.matches[near] - graph.pixels, axis=2)
    usual_px = float(np.median(flow_px)) if near.any() else 1.0
    # An inverse depth of usual_px / (focal x step) moves a pixel as far as the flow does: the search is centred there.
    middle = max(usual_px, 0.1) / (focal_px * max(reach, 1e-12))
    state = State(cam_from_world, np.full((graph.T, len(graph.pixels)), middle), focal_px, zoom, lens)
    return dba.normalise(search_depth(graph, dba.normalise(state), sigma_px))


def search_depth(graph: FlowGraph, state: State, sigma_px: float) -> State:
    """The state with every inverse depth replaced by the best of a sweep around its present value."""
    shape = state.inverse_depth.shape
    candidates = np.concatenate(
        [state.inverse_depth[None], np.broadcast_to(SWEEP[:, None, None], (len(SWEEP), *shape))]
    )
    inverse_depth = checkpoint.array(lambda: dba.sweep(graph, state, candidates, sigma_px)[0])
    return replace(state, inverse_depth=inverse_depth)


def adjust(
    graph: FlowGraph, state: State, schedule: Sequence[Level], unknowns: Unknowns, prior: FocalPrior, name: str
) -> Candidate:
    """Adjust an initial state and measure its cost and roughness."""
    state, steps = dba.solve(graph, state, schedule, unknowns, prior, name)
    cost = dba.robust_cost(graph, dba.errors_px(graph, state), schedule[-1].sigma_px)
    return Candidate(name, state, cost, roughness(state.cam_from_world, graph.times_s), steps)


def choose(candidates: Sequence[Candidate]) -> Candidate:
    """The smoothest camera path among the candidates whose cost is within COST_MARGIN of the lowest."""
    lowest = min(candidate.cost for candidate in candidates)
    near = [candidate for candidate in candidates if candidate.cost <= lowest * (1 + COST_MARGIN)]
    return min(near, key=lambda candidate: candidate.roughness)


def roughness(cam_from_world: np.ndarray, times_s: np.ndarray | None = None) -> float:
    """Mean acceleration over mean speed of the camera centres, per mean frame interval; 0 for a camera at rest.

    Args:
        times_s: of the frames, where a phone may have dropped some; None: evenly spaced.
    """
    velocity = np.diff(lie.inverse(cam_from_world)[:, :3, 3], axis=0)
    change = np.diff(velocity, axis=0)
    if times_s is not None:
        steps = np.diff(times_s) / np.mean(np.diff(times_s))
        velocity = velocity / steps[:, None]
        change = np.diff(velocity, axis=0) / ((steps[1:] + steps[:-1]) / 2)[:, None]
    speed = float(np.linalg.norm(velocity, axis=1).mean())
    return float(np.linalg.norm(change, axis=1).mean()) / speed if speed > 0 else 0.0


def _relative_scale(
    graph: FlowGraph,
    frames: tuple[int, int, int],
    motions: tuple[twoview.TwoView, twoview.TwoView],
    focals_px: Sequence[float],
) -> float:
    """Length of the second motion over that of the first, from the inverse depths of the middle frame in both."""
    (start, middle, end), (before, after), (f_start, f_middle, f_end) = frames, motions, focals_px
    forward, backward = graph.edge(middle, end), graph.edge(middle, start)
    if forward is None or backward is None:
        return 1.0
    rays = (graph.pixels - graph.centre) / f_middle
    ahead = (graph.matches[forward] - graph.centre) / f_end
    behind = (graph.matches[backward] - graph.centre) / f_start
    d_after, parallax_after = twoview.triangulate(after.R, after.t, rays, ahead)
    d_before, parallax_before = twoview.triangulate(before.R.T, -before.R.T @ before.t, rays, behind)
    sure = (graph.weights[forward] > 0.5) & (graph.weights[backward] > 0.5) & (d_after > 0) & (d_before > 0)
    if sure.sum() < MIN_MATCHES:
        return 1.0
    ratio = np.log(d_after[sure] / d_before[sure])
    weight = np.minimum(parallax_after * d_after, parallax_before * d_before)[sure]
    order = np.argsort(ratio)
    cumulative = np.cumsum(weight[order])
    return float(np.exp(ratio[order][np.searchsorted(cumulative, cumulative[-1] / 2)]))
