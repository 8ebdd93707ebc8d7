"""Closing of loops: the error that a path has gathered when it sees a place again is spread over the path.

Along a path without loops scale, rotation and position drift. Where the flow joins frames far apart, the drift is many
pixels, and a robust kernel would take these edges for outliers. So the relative similarity of each such pair is
measured from depth and flow, and a graph of similarities (Strasdat et al., Scale drift-aware large scale monocular
SLAM, RSS 2010) is solved over the poses, before the adjustment sees them. Its loops have a Geman-McClure kernel whose
scale falls step by step, so that wrong ones are left out: those that others contradict, or that bend the path beyond
its drift.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from stages.ba import dba, initialise
from stages.ba.graph import MIN_MATCHES, MIN_WEIGHT, FlowGraph
from stages.ba.similarities import Similarities
from stages.ba.state import FocalPrior, Level, State, Step, Unknowns
from stages.shared import lie
from stages.shared.cameras import grid_from_frame
from stages.shared.flow_pairs import REACH
from stages.shared.warp import bilinear

NEAREST = 0.02
"""Points with an inverse depth below this (the median is 1) say nothing of translation and scale."""
FITTING_PX, ITERATIONS, MIN_SHARE = 3.0, 200, 0.4
"""RANSAC of a pair: inlier threshold, iterations, least share of inliers."""
STEP_SIGMA = np.array([0.02, 0.02, 0.02, 0.003, 0.003, 0.003, 0.01])
"""Standard deviations of the motion between neighbouring frames: translation in units of its length, rotation in rad,
logarithm of the scale. They are those of drift, which adds up, and not of single steps: 5 % over a hundred frames."""
LOOP_SIGMA = np.array([0.03, 0.03, 0.03, 0.005, 0.005, 0.005, 0.03])
"""The same of a loop; translation in units of the depth, whose median is 1."""
KERNEL = 5.0
"""Last scale of the kernel on a loop, in standard deviations."""
GROWTH, STEPS = 2.0, 4
"""Factor between scales of the kernel, and the Gauss-Newton steps at each."""
MAX_STEP, HALVINGS = 0.5, 4
"""Largest angle, rad, and logarithm of the scale of a step; how short it is tried, by halves, before it is refused."""
MAX_TURN, MAX_SCALE, MAX_GAP = 1.5, 3.0, 1.0
"""No drift: a loop that the path misses by more than this angle, rad, log of the scale, or share of its length."""
WIDE = (Level(8.0, 8, 0.05), Level(4.0, 8, 0.05), Level(2.0, 8, 0.05))
"""Robust scales at which the closed path is adjusted first: what is left of the error is a few pixels. Each ends at a
small gain: the next one gains more."""


@dataclass(frozen=True)
class Closed:
    """A path after its loops were closed.

    Attributes:
        graph: without the edges of loops that were left out.
        state: the solution; steps: of its adjustment.
        facts: for the metadata of the poses: `loops` joined and `loops_left_out`, pairs of frames; `loop_gap_percent`,
            the median gap before, in % of the path between. Empty if there are no loops.
    """

    graph: FlowGraph
    state: State
    steps: list[Step]
    facts: dict[str, float]


def close(graph: FlowGraph, state: State, unknowns: Unknowns, prior: FocalPrior) -> Closed:
    """The state with the error of its loops spread over the path; the same without edges longer than REACH frames."""
    edges = np.flatnonzero(np.abs(graph.target - graph.source) > REACH)
    if not len(edges):
        return Closed(graph, state, [], {})
    measured = {e: found for e in edges.tolist() if (found := measure(graph, state, e)) is not None}
    if not measured:
        weights = np.where(np.isin(np.arange(len(graph.source)), edges)[:, None], 0, graph.weights)
        return Closed(replace(graph, weights=weights), state, [], {"loops": 0, "loops_left_out": len(edges) // 2})
    which = np.array(list(measured), int)
    between = Similarities(*(np.concatenate(part) for part in zip(*measured.values(), strict=True)))
    near = _is_drift(state.cam_from_world, _pairs(graph, which), between)
    which, between = which[near], between.at(np.flatnonzero(near))
    solved, weights = spread(state.cam_from_world, _pairs(graph, which), between)
    gaps = _gaps(state.cam_from_world, _pairs(graph, which), between)[weights > 0.5]
    joined = which[weights > 0.5]
    kept = np.isin(np.arange(len(graph.source)), joined) | (np.abs(graph.target - graph.source) <= REACH)
    graph = replace(graph, weights=graph.weights * kept[:, None])
    poses = lie.from_parts(solved.R, solved.t / solved.s[:, None])
    state = dba.normalise(replace(state, cam_from_world=poses, inverse_depth=state.inverse_depth * solved.s[:, None]))
    adjusted = initialise.adjust(graph, state, WIDE, unknowns, prior, "loops closed")
    pairs = [{tuple(sorted(pair)) for pair in _pairs(graph, of).tolist()} for of in (edges, joined)]
    facts: dict[str, float] = {"loops": len(pairs[1]), "loops_left_out": len(pairs[0] - pairs[1])}
    if len(gaps):
        facts["loop_gap_percent"] = 100 * float(np.median(gaps))
    return Closed(graph, adjusted.state, adjusted.steps, facts)


def measure(graph: FlowGraph, state: State, edge: int) -> Similarities | None:
    """The similarity that takes points of the source's camera to the target's, each at the scale of its own depths.

    Points of the source at their depth are seen at their matches: robust resection. The scale is the median ratio of
    the depths of the target there to those of the points.
    """
    i, j = int(graph.source[edge]), int(graph.target[edge])
    depth = state.inverse_depth[i]
    sure = (graph.weights[edge] > MIN_WEIGHT) & (depth > NEAREST)
    if sure.sum() < MIN_MATCHES:
        return None
    rays = np.pad((graph.pixels[sure] - graph.centre) / state.focals_px[i], ((0, 0), (0, 1)), constant_values=1)
    points, seen = rays / depth[sure, None], graph.matches[edge][sure].astype(float)
    focal_px, (cx, cy) = state.focals_px[j], graph.centre
    K = np.array([[focal_px, 0, cx], [0, focal_px, cy], [0, 0, 1]])
    cv2.setRNGSeed(0)
    found, turn, t, inliers = cv2.solvePnPRansac(
        points, seen, K, None, None, None, False, ITERATIONS, FITTING_PX, 0.999, None, cv2.SOLVEPNP_SQPNP
    )
    if not found or inliers is None or len(inliers) < max(MIN_MATCHES, MIN_SHARE * len(points)):
        return None
    chosen = inliers[:, 0]
    turn, t = cv2.solvePnPRefineLM(points[chosen], seen[chosen], K, None, turn, t)
    R = lie.exp_so3(turn[:, 0])
    z = (points[chosen] @ R.T + t[:, 0])[:, 2]
    cells = grid_from_frame(graph.on_grid(seen[chosen]), graph.stride)
    there = bilinear(state.inverse_depth[j].reshape(graph.rows, graph.columns), cells)
    usable = (z > 0) & (there > NEAREST)
    if usable.sum() < MIN_MATCHES:
        return None
    s = float(np.exp(-np.median(np.log(there[usable] * z[usable]))))
    return Similarities(np.array([s]), R[None], s * t.T)


def spread(cam_from_world: np.ndarray, pairs: np.ndarray, measured: Similarities) -> tuple[Similarities, np.ndarray]:
    """Poses [T, 4, 4] as similarities that agree with loops, the error spread over the path; the first pose is held.

    Args:
        pairs: [L, 2] source and target of the loops. measured: L similarities, target from source.

    Returns:
        T similarities, camera from world, and the robust weight [L] of the loops in 0..1.
    """
    T = len(cam_from_world)
    at = Similarities(np.ones(T), cam_from_world[:, :3, :3], cam_from_world[:, :3, 3])
    if not len(pairs):
        return at, np.zeros(0)
    step = np.stack([np.arange(T - 1), np.arange(1, T)], axis=1)
    motion = at.at(step[:, 1]) @ at.at(step[:, 0]).inverse()
    length = np.linalg.norm(motion.t, axis=1)
    sigmas = np.tile(STEP_SIGMA, (T - 1, 1))
    sigmas[:, :3] *= np.maximum(length, 0.1 * max(float(np.median(length)), 1e-9))[:, None]
    edges = np.concatenate([step, pairs])
    sigmas = np.concatenate([sigmas, np.tile(LOOP_SIGMA, (len(pairs), 1))])
    between = Similarities(*(np.concatenate(part) for part in zip(motion, measured, strict=True)))

    def cost(at: Similarities, weights: np.ndarray) -> float:
        return float((weights[:, None] * (_errors(at, edges, between) / sigmas) ** 2).sum())

    def away() -> np.ndarray:
        return np.asarray(np.linalg.norm(_errors(at, edges, between)[T - 1 :] / LOOP_SIGMA, axis=1))

    weights, widenings = np.ones(len(edges)), max(np.log(max(away().max() / KERNEL, 1)) / np.log(GROWTH), 0)
    for scale in KERNEL * GROWTH ** np.arange(np.ceil(widenings), -1, -1):
        for _ in range(STEPS):
            weights[T - 1 :] = 1 / (1 + (away() / scale) ** 2) ** 2
            step = _step(at, edges, between, np.sqrt(weights)[:, None] / sigmas)
            tried = [_moved(at, share * step) for share in 0.5 ** np.arange(HALVINGS)]
            at = min([at, *tried], key=lambda state: cost(state, weights))
    return at, 1 / (1 + (away() / KERNEL) ** 2) ** 2


def _pairs(graph: FlowGraph, edges: np.ndarray) -> np.ndarray:
    """Source and target [n, 2] of edges."""
    return np.stack([graph.source[edges], graph.target[edges]], axis=1)


def _gaps(cam_from_world: np.ndarray, pairs: np.ndarray, measured: Similarities) -> np.ndarray:
    """Distance [L] of the source's camera from where a loop sees it, as a share of the path between its two frames."""
    ends = cam_from_world[pairs[:, 1]] @ lie.inverse(cam_from_world)[pairs[:, 0]]
    centres = lie.inverse(cam_from_world)[:, :3, 3]
    walked = np.append(0, np.cumsum(np.linalg.norm(np.diff(centres, axis=0), axis=1)))
    gap = np.linalg.norm(ends[:, :3, 3] - measured.t / measured.s[:, None], axis=1)
    return np.asarray(gap / np.maximum(np.abs(walked[pairs[:, 1]] - walked[pairs[:, 0]]), 1e-12))


def _is_drift(cam_from_world: np.ndarray, pairs: np.ndarray, measured: Similarities) -> np.ndarray:
    """Which loops [L] the path misses by no more than its drift can be."""
    at = Similarities(np.ones(len(cam_from_world)), cam_from_world[:, :3, :3], cam_from_world[:, :3, 3])
    errors = np.abs(_errors(at, pairs, measured))
    turn, scale = np.linalg.norm(errors[:, 3:6], axis=1), errors[:, 6]
    return (turn < MAX_TURN) & (scale < MAX_SCALE) & (_gaps(cam_from_world, pairs, measured) < MAX_GAP)


def _errors(at: Similarities, edges: np.ndarray, between: Similarities) -> np.ndarray:
    """Errors [E, 7] of the edges: translation, rotation, logarithm of the scale."""
    return (between @ at.at(edges[:, 0]) @ at.at(edges[:, 1]).inverse()).log()


def _moved(at: Similarities, step: np.ndarray) -> Similarities:
    """After a step [T, 7] on the left of each."""
    return Similarities(np.exp(step[:, 6]), lie.exp_so3(step[:, 3:6]), step[:, :3]) @ at


def _step(at: Similarities, edges: np.ndarray, between: Similarities, scaling: np.ndarray) -> np.ndarray:
    """Gauss-Newton step [T, 7], zero for the first pose, no part of it larger than MAX_STEP in angle and scale.

    The derivatives are exact but for those of an error's rotation vector, which are those at zero.

    Args:
        scaling: [E, 7], roots of the weights over the standard deviations.
    """
    E, T = len(edges), len(at.s)
    left = between @ at.at(edges[:, 0]) @ at.at(edges[:, 1]).inverse()
    of_error = np.tile(np.eye(7), (E, 1, 1))
    of_error[:, :3, 3:6], of_error[:, :3, 6] = -lie.skew(left.t), left.t
    of_source = scaling[:, :, None] * (of_error @ between.adjoint())
    of_target = -scaling[:, :, None] * (of_error @ left.adjoint())
    rows = np.arange(7 * E).reshape(E, 7)
    values, indices = [], []
    for block, end in ((of_source, 0), (of_target, 1)):
        columns = 7 * edges[:, end, None] + np.arange(7)
        indices.append(np.stack(np.broadcast_arrays(rows[:, :, None], columns[:, None, :])).reshape(2, -1))
        values.append(block.ravel())
    J = sparse.csr_matrix((np.concatenate(values), np.concatenate(indices, axis=1)), (7 * E, 7 * T))[:, 7:]
    normal, gradient = J.T @ J, J.T @ (scaling * left.log()).ravel()
    step = np.zeros((T, 7))
    damped = normal + 1e-9 * sparse.diags(normal.diagonal())
    step[1:] = spsolve(damped.tocsc(), -gradient).reshape(-1, 7)
    return np.asarray(step * min(1.0, MAX_STEP / max(float(np.abs(step[:, 3:]).max()), 1e-12)))
