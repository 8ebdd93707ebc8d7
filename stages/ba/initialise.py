"""Poses from scratch: chains of two-view motions for several focal lengths and thresholds, adjusted and compared."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stages.ba import dba, twoview
from stages.ba.dba import FocalPrior, Level, State, Step, Unknowns
from stages.ba.graph import MIN_MATCHES, FlowGraph
from stages.shared import lie

SWEEP = np.geomspace(0.02, 10.0, 16)
"""Inverse depths, relative to the median, that the search for a pixel's depth starts from."""
COST_MARGIN = 0.15
"""Among solutions whose robust cost is this near to the lowest, cost does not tell the right one; smoothness does."""


@dataclass(frozen=True)
class Hypothesis:
    """A chain start: the focal length in px, the two-view threshold in px, pairs pooled on either side."""

    focal_px: float
    threshold_px: float
    pooled: int


@dataclass(frozen=True)
class Candidate:
    """An adjusted hypothesis: robust cost in px^2 and roughness of the camera path, mean |a| / mean |v|."""

    name: str
    state: State
    cost: float
    roughness: float
    steps: list[Step]


def chain(graph: FlowGraph, hypothesis: Hypothesis, seed: int) -> tuple[np.ndarray, int]:
    """Camera poses [T, 4, 4] chained from consecutive pairs, and the number of pairs without a model.

    The scale of each pair follows from the shared frame: the inverse depths seen forwards and backwards agree up to
    it (weighted median of their log ratio). A pair without a model repeats the motion before it.
    """
    cam_from_world = np.tile(np.eye(4), (graph.T, 1, 1))
    motion, scale, lost = lie.from_parts(np.eye(3), np.zeros(3)), 1.0, 0
    before: twoview.TwoView | None = None
    for i in range(graph.T - 1):
        pair = _pair_motion(graph, i, hypothesis, seed)
        if pair is None:
            lost += 1
        else:
            if before is not None:
                scale *= _relative_scale(graph, i, before, pair, hypothesis.focal_px)
            motion = lie.from_parts(pair.R, scale * pair.t)
            before = pair
        cam_from_world[i + 1] = motion @ cam_from_world[i]
    return cam_from_world, lost


def initial_state(graph: FlowGraph, cam_from_world: np.ndarray, focal_px: float, sigma_px: float = 1.0) -> State:
    """State in the gauge from poses alone: the inverse depth of every pixel is searched with the poses fixed."""
    reach = float(np.median(np.linalg.norm(np.diff(cam_from_world[:, :3, 3], axis=0), axis=1)))
    flow_px = np.linalg.norm(graph.matches - graph.pixels, axis=2)
    steps = np.abs(graph.target - graph.source)
    usual_px = float(np.median(flow_px[steps == 1])) if (steps == 1).any() else 1.0
    # An inverse depth of usual_px / (focal x step) moves a pixel as far as the flow does: the middle of the search.
    middle = max(usual_px, 0.1) / (focal_px * max(reach, 1e-12))
    state = State(cam_from_world, np.full((graph.T, len(graph.pixels)), middle), focal_px)
    return dba.normalise(search_depth(graph, dba.normalise(state), sigma_px))


def search_depth(graph: FlowGraph, state: State, sigma_px: float) -> State:
    """The state with every inverse depth replaced by the best of a sweep around its present value."""
    shape = state.inverse_depth.shape
    candidates = np.concatenate(
        [state.inverse_depth[None], np.broadcast_to(SWEEP[:, None, None], (len(SWEEP), *shape))]
    )
    inverse_depth, _ = dba.sweep(graph, state, candidates, sigma_px)
    return State(state.cam_from_world, inverse_depth, state.focal_px)


def adjust(
    graph: FlowGraph, state: State, schedule: Sequence[Level], unknowns: Unknowns, prior: FocalPrior, name: str
) -> Candidate:
    """Adjust a start and measure what hypotheses are compared by."""
    state, steps = dba.solve(graph, state, schedule, unknowns, prior, name)
    cost = dba.robust_cost(graph, dba.errors_px(graph, state), schedule[-1].sigma_px)
    return Candidate(name, state, cost, roughness(state.cam_from_world), steps)


def choose(candidates: Sequence[Candidate], margin: float = COST_MARGIN) -> Candidate:
    """The smoothest camera path among the candidates whose cost is within `margin` of the lowest."""
    lowest = min(candidate.cost for candidate in candidates)
    near = [candidate for candidate in candidates if candidate.cost <= lowest * (1 + margin)]
    return min(near, key=lambda candidate: candidate.roughness)


def roughness(cam_from_world: np.ndarray) -> float:
    """Mean acceleration over mean speed of the camera centres, per frame; 0 for a camera at rest."""
    velocity = np.diff(lie.inverse(cam_from_world)[:, :3, 3], axis=0)
    speed = float(np.linalg.norm(velocity, axis=1).mean())
    return float(np.linalg.norm(np.diff(velocity, axis=0), axis=1).mean()) / speed if speed > 0 else 0.0


def _pair_motion(graph: FlowGraph, i: int, hypothesis: Hypothesis, seed: int) -> twoview.TwoView | None:
    """Motion of frames i, i + 1, started from the pooled matches of the pairs around it where that is asked for."""
    f, threshold_px, reach = hypothesis.focal_px, hypothesis.threshold_px, hypothesis.pooled
    own = twoview.pair_rays(graph, i, i + 1, f)
    if not reach:
        return twoview.estimate_motion(*own, f, threshold_px, seed)
    first = int(np.clip(i - reach, 0, max(graph.T - 2 - 2 * reach, 0)))
    pairs = [twoview.pair_rays(graph, k, k + 1, f) for k in range(first, min(first + 2 * reach, graph.T - 2) + 1)]
    x, y, w = (np.concatenate(parts)[::2] for parts in zip(*pairs, strict=True))
    pooled = twoview.estimate_motion(x, y, w, f, threshold_px, seed)
    if pooled is None or len(own[0]) < MIN_MATCHES:
        return pooled
    return twoview.refine_motion(pooled.R, pooled.t, *own, f, (1.5 * threshold_px, threshold_px), iterations=8)


def _relative_scale(
    graph: FlowGraph, i: int, before: twoview.TwoView, after: twoview.TwoView, focal_px: float
) -> float:
    """Length of the motion i -> i + 1 over that of i - 1 -> i, from the inverse depths that frame i has in both."""
    forward, backward = graph.edge(i, i + 1), graph.edge(i, i - 1)
    if forward is None or backward is None:
        return 1.0
    rays = (graph.pixels - graph.centre) / focal_px
    ahead = (graph.matches[forward] - graph.centre) / focal_px
    behind = (graph.matches[backward] - graph.centre) / focal_px
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
