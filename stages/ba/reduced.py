"""The reduced system of bundle adjustment: poses and focal lengths, after elimination of the inverse depths.

The unknowns are the twists of T poses, then one log focal, or T if every frame has its own, then the two coefficients
of a lens if there is one.
"""

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
    """Sum the local systems of all frames into one over (twists of T poses, log focal) or (twists, T log focals).

    A left twist of the pose of the source acts on an edge as -Ad(target_from_source), so with the local unknowns
    stacked as L x the system is L^T (H - schur) L (Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000).

    Returns:
        S [6T + 1, 6T + 1] and right-hand side [6T + 1]; with T focal lengths 7T in place of 6T + 1; two more of a lens.
    """
    T, lens = graph.T, 2 if hessians.shape[1] > 9 else 0
    rows, shared = hessians.shape[1] - 2 - lens, 1 + lens
    zoom = rows > 6
    focals = T if zoom else 1
    size = 6 * T + focals + lens
    S, rhs = np.zeros((size, size)), np.zeros(size)
    adjoints = lie.adjoint(relative)
    for i in range(T):
        first, last = graph.pointer[i], graph.pointer[i + 1]
        k = last - first
        n = rows * k
        H = hessians[first:last]
        m = n + shared
        local = -schur[i, : m + 1, : m + 1]
        local[:n, :n].reshape(k, rows, k, rows)[np.arange(k), :, np.arange(k)] += H[:, :rows, :rows]
        local[:n, n:] += H[:, :rows, rows:].reshape(n, shared + 1)
        local[n:, :n] += H[:, rows:, :rows].transpose(1, 0, 2).reshape(shared + 1, n)
        local[n:, n:] += H[:, rows:, rows:].sum(axis=0)
        A = np.zeros((k, rows, 6))
        A[:, :6] = -adjoints[first:last]
        A = A.reshape(n, 6)
        columns = 6 * graph.target[first:last, None] + np.arange(6)
        if zoom:
            columns = np.append(columns, 6 * T + graph.target[first:last, None], axis=1)
        of_lens = 6 * T + focals + np.arange(lens)
        columns = np.concatenate([columns.ravel(), [6 * T + (i if zoom else 0)], of_lens])
        source = slice(6 * i, 6 * i + 6)
        across = A.T @ local[:n]
        S[np.ix_(columns, columns)] += local[:m, :m]
        S[source, columns] += across[:, :m]
        S[columns, source] += across[:, :m].T
        S[source, source] += across[:, :n] @ A
        rhs[columns] += local[:m, m]
        rhs[source] += across[:, m]
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


def edge_steps(graph: FlowGraph, relative: np.ndarray, step: np.ndarray, lens: bool = False) -> np.ndarray:
    """Local steps of a step of all unknowns, [6T + 1] or [7T], or two more with a lens.

    Returns:
        [E, 7] (twist of the target seen from the source, log focal), or [E, 8] (twist, log focal of target, of source);
        [E, 9] or [E, 10] with a lens, its coefficients last.
    """
    if lens:
        local = edge_steps(graph, relative, step[:-2])
        return np.concatenate([local, np.tile(step[-2:], (len(local), 1))], axis=1)
    T = graph.T
    twists, focals = step[: 6 * T].reshape(-1, 6), step[6 * T :]
    seen = np.einsum("eab,eb->ea", lie.adjoint(relative), twists[graph.source])
    local = twists[graph.target] - seen
    if len(focals) == 1:
        return np.concatenate([local, np.full((len(local), 1), focals[0])], axis=1)
    return np.concatenate([local, focals[graph.target, None], focals[graph.source, None]], axis=1)


def scale_gauge(S: np.ndarray, cam_from_world: np.ndarray) -> np.ndarray:
    """A stiff term of the shape of S that fixes the scale of the trajectory.

    Scaling the world moves the unknowns along s = (translation, 0) per pose and changes no residual; the row
    s^T x = 0 removes that direction without touching the others.
    """
    s = np.zeros(len(S))
    s[: 6 * len(cam_from_world)].reshape(-1, 6)[:, :3] = cam_from_world[:, :3, 3]
    s[np.diagonal(S) == 0] = 0  # frames without matches: their scale could offset that of all others at no cost
    squared = s @ s
    return np.trace(S) / len(S) * np.outer(s, s) / squared if squared > 0 else np.zeros_like(S)


def covariance(S: np.ndarray, cam_from_world: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Covariance, of the shape of S, for unit flow variance, in the gauge: first pose and trajectory scale fixed.

    Unknowns that are not free have covariance 0. Curvature has a floor of 1e-12 of its mean, so that unobserved
    directions get a large variance instead of infinity.
    """
    values, vectors = np.linalg.eigh((S + scale_gauge(S, cam_from_world))[np.ix_(free, free)])
    floor = 1e-12 * max(float(values.mean()), 1e-300)
    full = np.zeros_like(S)
    full[np.ix_(free, free)] = (vectors / np.maximum(values, floor)) @ vectors.T
    return full
