"""One step of the adjustment: the reduced system of a state with its priors, its solution, and then the depths."""

from collections.abc import Iterator

import numpy as np

from stages.ba import reduced
from stages.ba.arguments import geometry, lens_px, limits, observations
from stages.ba.band_layout import layout
from stages.ba.banded_system import BandedSystem
from stages.ba.dense_system import DenseSystem
from stages.ba.graph import FlowGraph
from stages.ba.normal_equations import depth_steps, normal_equations
from stages.ba.reduced import Term
from stages.ba.state import (
    DEPTH_PRIOR,
    LENS_PRIOR,
    SMOOTHNESS,
    FocalPrior,
    State,
    Unknowns,
    prior_share,
)
from stages.shared import lie

MAX_LOG_FOCAL_STEP = 0.35
MAX_LENS_STEP = 0.05
"""Largest step of a coefficient of the lens: what it moves a corner by, as a share of its distance to the centre."""
DENSE_FRAMES = 100
"""Up to this many frames the system is dense, so that short sequences keep their numbers bit for bit. Its factors take
1 ms of 50 frames, 5 of 100 and 22 of 200 (one thread, edges over up to 5 frames), in a band with its making 2, 2 and 3.
"""

RIDGE, RIDGE_OF_LONG = 1e-9, 1e-12
"""Curvature in every direction, relative to the mean: the slow bends of a long path have less than the first."""

System = DenseSystem | BandedSystem


def propose(
    graph: FlowGraph, state: State, sigma_px: float, damping: float, unknowns: Unknowns, prior: FocalPrior
) -> tuple[State | None, float]:
    """The state after one damped Gauss-Newton step, and the length of the step; None if the system is singular."""
    prior, depth_prior = prior.at(sigma_px), prior_share(sigma_px) * DEPTH_PRIOR
    relative = reduced.relative_motions(graph, state.cam_from_world)
    data, at, lens, T = observations(graph, state.lens), geometry(graph, state), lens_px(graph, state), graph.T
    hessians, schur, curvatures, gradients = normal_equations(
        data, at, float(sigma_px), damping, depth_prior, unknowns.zoom, lens
    )
    system = _sum(graph, state, unknowns, relative, hessians, schur)
    for term in _prior_terms(state, unknowns, prior):
        system.add(term)
    if unknowns.zoom:
        system.stiffen(prior.weight / T, _of_focals(len(system.diagonal), T))
    try:
        step = system.step(damping, RIDGE if T <= DENSE_FRAMES else RIDGE_OF_LONG)
    except np.linalg.LinAlgError:
        return None, 0.0
    focals = slice(6 * T, 7 * T if unknowns.zoom else 6 * T + 1)
    step[focals] = np.clip(step[focals], -MAX_LOG_FOCAL_STEP, MAX_LOG_FOCAL_STEP)
    step[focals.stop :] = np.clip(step[focals.stop :], -MAX_LENS_STEP, MAX_LENS_STEP)
    inverse_depth = state.inverse_depth
    if unknowns.translation:
        local_steps = reduced.edge_steps(graph, relative, step, state.lens is not None)
        inverse_depth = inverse_depth + depth_steps(data, at, float(sigma_px), curvatures, gradients, local_steps, lens)
        inverse_depth = np.clip(inverse_depth, *limits(graph))
    return _moved(state, step, inverse_depth, unknowns), float(np.linalg.norm(step))


def linear_system(graph: FlowGraph, state: State, sigma_px: float, unknowns: Unknowns) -> System:
    """The undamped reduced system of a state without priors but for that on the curve of the zoom, its scale fixed.

    Depths are eliminated; held fixed without translation.
    """
    relative = reduced.relative_motions(graph, state.cam_from_world)
    data, at, lens = observations(graph, state.lens), geometry(graph, state), lens_px(graph, state)
    hessians, schur, _, _ = normal_equations(data, at, float(sigma_px), 0.0, DEPTH_PRIOR, unknowns.zoom, lens)
    system = _sum(graph, state, unknowns, relative, hessians, schur)
    if unknowns.zoom:
        for term in _smoothness(np.zeros(graph.T)):
            system.add(term)
    return system


def _sum(
    graph: FlowGraph,
    state: State,
    unknowns: Unknowns,
    relative: np.ndarray,
    hessians: np.ndarray,
    schur: np.ndarray,
) -> System:
    """The sum of the local systems of all frames, with a stiff term that fixes the scale of the trajectory."""
    T = graph.T
    if not unknowns.translation:
        schur[:] = 0.0
    size, free = 6 * T + (T if unknowns.zoom else 1) + (0 if state.lens is None else 2), unknowns.indices(T)
    system: System = DenseSystem(size, free)
    if T > DENSE_FRAMES:
        system = BandedSystem(layout(graph, size, free, unknowns.zoom))
    for term in reduced.frame_terms(graph, relative, hessians, schur):
        system.add(term)
    scale = reduced.scale_direction(state.cam_from_world, system.diagonal)
    system.stiffen(float(system.diagonal.sum()) / size, scale)
    return system


def _prior_terms(state: State, unknowns: Unknowns, prior: FocalPrior) -> Iterator[Term]:
    """The priors on focal lengths and lens, but for the curvature of that on the mean of many focal lengths."""
    T, apart = len(state.cam_from_world), from_prior(state, unknowns, prior)
    focals = 6 * T + np.arange(len(apart))
    if unknowns.zoom:
        yield from _smoothness(apart)
        for focal in focals:
            yield Term(np.array([focal]), np.zeros((1, 1)), np.array([prior.weight * apart.mean() / T]))
    else:
        yield Term(focals, np.array([[prior.weight]]), prior.weight * apart)
    if state.lens is not None:
        yield Term(focals[-1] + 1 + np.arange(2), LENS_PRIOR * np.eye(2), -LENS_PRIOR * state.lens)


def _smoothness(apart: np.ndarray) -> Iterator[Term]:
    """The prior that log focals [T], `apart` from where the step is to take them, have no second differences."""
    T, bend = len(apart), np.array([1.0, -2.0, 1.0])
    for k in range(T - 2):
        unknowns = 6 * T + k + np.arange(3)
        yield Term(unknowns, SMOOTHNESS * np.outer(bend, bend), SMOOTHNESS * (bend @ apart[k : k + 3]) * bend)


def _of_focals(size: int, T: int) -> np.ndarray:
    """The direction, of all unknowns, in which all T log focals move alike."""
    direction = np.zeros(size)
    direction[6 * T : 7 * T] = 1.0
    return direction


def _moved(state: State, step: np.ndarray, inverse_depth: np.ndarray, unknowns: Unknowns) -> State:
    """The state after a step of poses, focal lengths and lens, with these inverse depths."""
    T = len(state.cam_from_world)
    focals = slice(6 * T, 7 * T if unknowns.zoom else 6 * T + 1)
    cam_from_world = lie.exp_se3(step[: 6 * T].reshape(-1, 6)) @ state.cam_from_world
    focal_px, zoom = float(state.focal_px * np.exp(step[focals].mean())), state.zoom
    if unknowns.zoom:
        zoom = state.focals_px * np.exp(step[focals]) / focal_px
    bent = None if state.lens is None else state.lens + step[focals.stop :]
    return State(cam_from_world, inverse_depth, focal_px, zoom, bent)


def from_prior(state: State, unknowns: Unknowns, prior: FocalPrior) -> np.ndarray:
    """Logarithms of the prior's centre over the focal length, [1], or over those of all frames, [T]."""
    return np.asarray(np.log(prior.focal_px / (state.focals_px if unknowns.zoom else np.array([state.focal_px]))))
