"""Dense bundle adjustment: Levenberg-Marquardt on a graduated Geman-McClure cost; steps that raise it are rejected."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from stages.ba import kernel, reduced, residuals
from stages.ba.graph import FlowGraph
from stages.shared import lie
from stages.shared.lens import undistort

DEPTH_PRIOR = 1e-4
"""Weight, px^2, of the prior that an inverse depth is the median 1: far below the weight of one useful match."""
FLOW_VARIANCE = 1.5
"""Variance of a match, px^2, relative to which the focal length prior is weighted."""
LENS_PRIOR = FLOW_VARIANCE / 0.3**2
"""Weight of the prior that a lens has no distortion: the standard deviation is 0.3 of the way to a corner."""
INVERSE_DEPTHS = (1e-4, 20.0)
"""Range of inverse depths, relative to their median."""
REFINEMENTS = 2
"""Gauss-Newton steps from every candidate of a sweep for inverse depths."""
MAX_LOG_FOCAL_STEP = 0.35
MAX_LENS_STEP = 0.05
"""Largest step of a coefficient of the lens: what it moves a corner by, as a share of its distance to the centre."""
ZOOM_BEND = 0.02
"""Standard deviation of the second differences of the log focal over frames, relative to flow errors as they are: alike
over many pixels (a lens that starts to double its focal length within a second bends it by 0.03 in one frame)."""
MAX_DAMPING = 1e4


@dataclass(frozen=True)
class State:
    """The unknowns of bundle adjustment. The gauge: first pose identity, median inverse depth 1.

    Attributes:
        cam_from_world: [T, 4, 4].
        inverse_depth: [T, P], of the pixels of the graph.
        focal_px: focal length on the flow grid, of all frames or their geometric mean.
        zoom: [T] focal length of each frame over `focal_px`; None: all have the same.
        lens: [2] c1 and c2 of the distortion q (1 + c1 s + c2 s^2) of a pixel q about the centre, with s = |q|^2 over
            that of a corner of the image; None: a pinhole.
    """

    cam_from_world: np.ndarray
    inverse_depth: np.ndarray
    focal_px: float
    zoom: np.ndarray | None = None
    lens: np.ndarray | None = None

    @property
    def focals_px(self) -> np.ndarray:
        """Focal length [T] of every frame."""
        return self.focal_px * (np.ones(len(self.cam_from_world)) if self.zoom is None else self.zoom)


@dataclass(frozen=True)
class Unknowns:
    """Which unknowns are free. Without translation the depths are unobservable and stay as they are.

    With `zoom`, which includes `focal`, every frame has a focal length of its own. `lens` is the number of free
    coefficients of a lens that has them.
    """

    focal: bool = False
    translation: bool = True
    zoom: bool = False
    lens: int = 0

    def indices(self, T: int) -> np.ndarray:
        """Indices of the free unknowns among (twists of T poses, log focals, lens); the first pose is fixed."""
        twists = np.arange(6, 6 * T).reshape(-1, 6)[:, 0 if self.translation else 3 :]
        focals = np.arange(6 * T, 7 * T) if self.zoom else [6 * T] if self.focal else []
        lens = (7 * T if self.zoom else 6 * T + 1) + np.arange(self.lens)
        return np.concatenate([twists.ravel(), focals, lens]).astype(int)


@dataclass(frozen=True)
class FocalPrior:
    """Log-normal prior of the focal length: centre in px and standard deviation of the logarithm.

    It is one of the mean over the frames where each has its own, whose curve is smooth besides: `ZOOM_BEND`.
    """

    focal_px: float
    log_sigma: float = 0.35

    @property
    def weight(self) -> float:
        """Curvature in units of px^2 of flow error."""
        return FLOW_VARIANCE / self.log_sigma**2

    def curvature(self, n: int) -> np.ndarray:
        """Curvature [n, n] by n log focals, 1 or one per frame, px^2."""
        return np.full((n, n), self.weight / n**2) + smoothness(n)


class Level(NamedTuple):
    """One stage of the graduated robust kernel: its scale in px and its largest number of iterations.

    It ends early at a step that lowers the cost by less than the relative amount `gain`.
    """

    sigma_px: float
    iterations: int
    gain: float = 1e-5


@dataclass(frozen=True)
class Step:
    """One iteration, as `ba/convergence.parquet` shows it."""

    phase: str
    sigma_px: float
    cost: float
    step: float
    damping: float
    focal_px: float
    accepted: bool
    seconds: float


def smoothness(n: int) -> np.ndarray:
    """Curvature [n, n] of the prior that the log focals of n frames have no second differences, px^2."""
    bends = np.diff(np.eye(n), 2, axis=0)
    return np.asarray(FLOW_VARIANCE / ZOOM_BEND**2 * bends.T @ bends)


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


def linear_system(
    graph: FlowGraph, state: State, sigma_px: float, eliminate: bool = True, zoom: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Undamped reduced system S [6T + 1, 6T + 1] and right-hand side; depths eliminated, or held fixed.

    With `zoom`, over the log focals of all frames, S is [7T, 7T]; behind a lens it has two more rows.
    """
    relative = reduced.relative_motions(graph, state.cam_from_world)
    data, at, lens = observations(graph, state.lens), geometry(graph, state), lens_px(graph, state)
    hessians, schur, _, _ = kernel.normal_equations(data, at, float(sigma_px), 0.0, DEPTH_PRIOR, zoom, lens)
    return reduced.assemble(graph, relative, hessians, schur if eliminate else np.zeros_like(schur))


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
    steps: list[Step] = []
    damping = 1e-3
    state = normalise(state) if unknowns.translation else state
    for level in schedule:
        cost = _objective(graph, state, level.sigma_px, unknowns, prior)
        for _ in range(level.iterations):
            start_s = time.perf_counter()
            proposal, size = propose(graph, state, level.sigma_px, damping, unknowns, prior)
            proposed = _objective(graph, proposal, level.sigma_px, unknowns, prior) if proposal else np.inf
            accepted = proposal is not None and proposed <= cost
            gain = (cost - proposed) / max(cost, 1e-300)
            if accepted and proposal:
                state, cost, damping = proposal, proposed, max(damping / 5, 1e-7)
            else:
                damping *= 8
            seconds = time.perf_counter() - start_s
            steps.append(Step(phase, level.sigma_px, cost, size, damping, state.focal_px, accepted, seconds))
            if (accepted and gain < level.gain) or damping > MAX_DAMPING:
                break
    return normalise(state) if unknowns.translation else state, steps


def propose(
    graph: FlowGraph, state: State, sigma_px: float, damping: float, unknowns: Unknowns, prior: FocalPrior
) -> tuple[State | None, float]:
    """The state after one damped Gauss-Newton step, and the length of the step; None if the system is singular."""
    relative = reduced.relative_motions(graph, state.cam_from_world)
    data, at, lens, T = observations(graph, state.lens), geometry(graph, state), lens_px(graph, state), graph.T
    hessians, schur, curvatures, gradients = kernel.normal_equations(
        data, at, float(sigma_px), damping, DEPTH_PRIOR, unknowns.zoom, lens
    )
    if not unknowns.translation:
        schur[:] = 0.0
    S, rhs = reduced.assemble(graph, relative, hessians, schur)
    S += reduced.scale_gauge(S, state.cam_from_world)
    focals = slice(6 * T, 7 * T if unknowns.zoom else 6 * T + 1)
    pull = prior.curvature(focals.stop - focals.start)
    S[focals, focals] += pull
    rhs[focals] += pull @ _from_prior(state, unknowns, prior)
    if state.lens is not None:
        S[focals.stop :, focals.stop :] += LENS_PRIOR * np.eye(2)
        rhs[focals.stop :] -= LENS_PRIOR * state.lens
    try:
        step = reduced.solve_damped(S, rhs, unknowns.indices(T), damping)
    except np.linalg.LinAlgError:
        return None, 0.0
    step[focals] = np.clip(step[focals], -MAX_LOG_FOCAL_STEP, MAX_LOG_FOCAL_STEP)
    step[focals.stop :] = np.clip(step[focals.stop :], -MAX_LENS_STEP, MAX_LENS_STEP)
    inverse_depth = state.inverse_depth
    if unknowns.translation:
        local_steps = reduced.edge_steps(graph, relative, step, state.lens is not None)
        inverse_depth = inverse_depth + kernel.depth_steps(
            data, at, float(sigma_px), curvatures, gradients, local_steps, lens
        )
        inverse_depth = np.clip(inverse_depth, *INVERSE_DEPTHS)
    cam_from_world = lie.exp_se3(step[: 6 * T].reshape(-1, 6)) @ state.cam_from_world
    focal_px, zoom = float(state.focal_px * np.exp(step[focals].mean())), state.zoom
    if unknowns.zoom:
        zoom = state.focals_px * np.exp(step[focals]) / focal_px
    bent = None if state.lens is None else state.lens + step[focals.stop :]
    return State(cam_from_world, inverse_depth, focal_px, zoom, bent), float(np.linalg.norm(step))


def _from_prior(state: State, unknowns: Unknowns, prior: FocalPrior) -> np.ndarray:
    """Logarithms of the prior's centre over the focal length, [1], or over those of all frames, [T]."""
    return np.asarray(np.log(prior.focal_px / (state.focals_px if unknowns.zoom else np.array([state.focal_px]))))


def _objective(graph: FlowGraph, state: State, sigma_px: float, unknowns: Unknowns, prior: FocalPrior) -> float:
    """Objective of Levenberg-Marquardt: data, depth prior and focal prior, per unit of weight, px^2."""
    total_weight = max(float(graph.weights.sum(dtype=float)), 1e-12)
    cost = robust_cost(graph, errors_px(graph, state), sigma_px)
    if unknowns.translation:
        cost += DEPTH_PRIOR * float(((state.inverse_depth - 1) ** 2).sum()) / total_weight
    if unknowns.focal:
        apart = _from_prior(state, unknowns, prior)
        cost += float(apart @ prior.curvature(len(apart)) @ apart) / total_weight
    if state.lens is not None:
        cost += LENS_PRIOR * float(state.lens @ state.lens) / total_weight
    return cost


def observations(graph: FlowGraph, lens: np.ndarray | None = None) -> kernel.EdgeMatches:
    """The graph in the form that the kernels take; the pixels without the distortion `lens` of a `State`."""
    pixels = graph.pixels if lens is None else undistorted(graph, lens, graph.pixels)
    return kernel.EdgeMatches(graph.pointer, graph.source, graph.target, pixels, graph.matches, graph.weights)


def undistorted(graph: FlowGraph, lens: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Pixels [..., 2] of the flow grid without the distortion `lens` [2] of a `State`."""
    radius = graph.corner_px
    return graph.centre + radius * undistort((pixels - graph.centre) / radius, lens)


def lens_px(graph: FlowGraph, state: State) -> np.ndarray:
    """The lens in the form that the kernels take."""
    return kernel.PINHOLE if state.lens is None else np.append(state.lens, graph.corner_px)


def geometry(graph: FlowGraph, state: State) -> kernel.Geometry:
    """The state in the form that the kernels take."""
    relative = reduced.relative_motions(graph, state.cam_from_world)
    R, t = np.ascontiguousarray(relative[:, :3, :3]), np.ascontiguousarray(relative[:, :3, 3])
    return kernel.Geometry(R, t, state.inverse_depth, state.focals_px, graph.centre)
