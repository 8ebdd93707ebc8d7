"""The reduced system of bundle adjustment: poses and focal length, after elimination of the inverse depths."""

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from stages.ba.graph import FlowGraph
from stages.shared import lie


def relative_motions(graph: FlowGraph, cam_from_world: np.ndarray) -> np.ndarray:
    """target_from_source [E, 4, 4] of every edge."""
    return np.asarray(cam_from_world[graph.target] @ lie.inverse(cam_from_world)[graph.source])


def assemble(
    graph: FlowGraph, relative: np.ndarray, hessians: np.ndarray, schur: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Sum the local systems of all frames into one over (twists of T poses, log focal).

    A left twist of the pose of the source acts on an edge as -Ad(target_from_source), so with the local unknowns
    stacked as L x the system is L^T (H - schur) L (Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000).

    Returns:
        S [6T + 1, 6T + 1] and right-hand side [6T + 1].
    """
    T = graph.T
    S, rhs = np.zeros((6 * T + 1, 6 * T + 1)), np.zeros(6 * T + 1)
    adjoints = lie.adjoint(relative)
    for i in range(T):
        first, last = graph.pointer[i], graph.pointer[i + 1]
        k = last - first
        n = 6 * k
        H = hessians[first:last]
        local = -schur[i, : n + 2, : n + 2]
        local[:n, :n].reshape(k, 6, k, 6)[np.arange(k), :, np.arange(k)] += H[:, :6, :6]
        local[:n, n:] += H[:, :6, 6:].reshape(n, 2)
        local[n:, :n] += H[:, 6:, :6].transpose(1, 0, 2).reshape(2, n)
        local[n:, n:] += H[:, 6:, 6:].sum(axis=0)
        A = -adjoints[first:last].reshape(n, 6)
        columns = np.append((6 * graph.target[first:last, None] + np.arange(6)).ravel(), 6 * T)
        source = slice(6 * i, 6 * i + 6)
        across = A.T @ local[:n]
        S[np.ix_(columns, columns)] += local[: n + 1, : n + 1]
        S[source, columns] += across[:, : n + 1]
        S[columns, source] += across[:, : n + 1].T
        S[source, source] += across[:, :n] @ A
        rhs[columns] += local[: n + 1, n + 1]
        rhs[source] += across[:, n + 1]
    return S, rhs


def solve_damped(S: np.ndarray, rhs: np.ndarray, free: np.ndarray, damping: float) -> np.ndarray:
    """Step of the free unknowns (indices) with Levenberg-Marquardt damping; zero for the others.

    Raises:
        numpy.linalg.LinAlgError: if the damped system is not positive definite.
    """
    A = S[np.ix_(free, free)]
    A = A + np.diag(damping * np.diag(A) + 1e-9 * np.trace(A) / len(A) + 1e-300)
    step = np.zeros(len(rhs))
    step[free] = cho_solve(cho_factor(A, check_finite=False), rhs[free], check_finite=False)
    return step


def edge_steps(graph: FlowGraph, relative: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Local steps [E, 7] (twist of the target seen from the source, log focal) of a step [6T + 1] of all unknowns."""
    twists = step[:-1].reshape(-1, 6)
    seen = np.einsum("eab,eb->ea", lie.adjoint(relative), twists[graph.source])
    local = twists[graph.target] - seen
    return np.concatenate([local, np.full((len(local), 1), step[-1])], axis=1)


def scale_gauge(S: np.ndarray, cam_from_world: np.ndarray) -> np.ndarray:
    """A stiff term [6T + 1, 6T + 1] that fixes the scale of the trajectory.

    Scaling the world moves the unknowns along s = (translation, 0) per pose and changes no residual; the row
    s^T x = 0 removes that direction without touching the others.
    """
    s = np.zeros(len(S))
    s[:-1].reshape(-1, 6)[:, :3] = cam_from_world[:, :3, 3]
    s[np.diagonal(S) == 0] = 0  # frames without matches: their scale could offset that of all others at no cost
    squared = s @ s
    return np.trace(S) / len(S) * np.outer(s, s) / squared if squared > 0 else np.zeros_like(S)


def covariance(S: np.ndarray, cam_from_world: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Covariance [6T + 1, 6T + 1] for unit flow variance, in the gauge: first pose and trajectory scale fixed.

    Unknowns that are not free have covariance 0. Curvature has a floor of 1e-12 of its mean, so that unobserved
    directions get a large variance instead of infinity.
    """
    values, vectors = np.linalg.eigh((S + scale_gauge(S, cam_from_world))[np.ix_(free, free)])
    floor = 1e-12 * max(float(values.mean()), 1e-300)
    full = np.zeros_like(S)
    full[np.ix_(free, free)] = (vectors / np.maximum(values, floor)) @ vectors.T
    return full
