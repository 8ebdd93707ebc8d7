"""The reduced system of bundle adjustment: poses and focal lengths, after elimination of the inverse depths.

The unknowns are the twists of T poses, then one log focal, or T if every frame has its own, then the two coefficients
of a lens if there is one.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from stages.ba.graph import FlowGraph
from stages.shared import lie


def relative_motions(graph: FlowGraph, cam_from_world: np.ndarray) -> np.ndarray:
    """target_from_source [E, 4, 4] of every edge."""
    return np.asarray(cam_from_world[graph.target] @ lie.inverse(cam_from_world)[graph.source])


class Term(NamedTuple):
    """A quadratic x^T M x / 2 - g^T x of some of the unknowns x.

    Attributes:
        unknowns: their indices [n], all different; matrix: M [n, n]; gradient: g [n].
    """

    unknowns: np.ndarray
    matrix: np.ndarray
    gradient: np.ndarray


def frame_terms(graph: FlowGraph, relative: np.ndarray, hessians: np.ndarray, schur: np.ndarray) -> Iterator[Term]:
    """The local system of every frame, over the poses of its targets, what is shared, and its own pose.

    A left twist of the pose of the source acts on an edge as -Ad(target_from_source), so with the local unknowns
    stacked as L x the system is L^T (H - schur) L (Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000).
    """
    T, lens = graph.T, 2 if hessians.shape[1] > 9 else 0
    rows, shared = hessians.shape[1] - 2 - lens, 1 + lens
    zoom = rows > 6
    focals = T if zoom else 1
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
        source = 6 * i + np.arange(6)
        across = A.T @ local[:n]
        matrix = np.empty((m + 6, m + 6))
        matrix[:m, :m], matrix[m:, :m], matrix[:m, m:] = local[:m, :m], across[:, :m], across[:, :m].T
        matrix[m:, m:] = across[:, :n] @ A
        unknowns = np.concatenate([columns.ravel(), [6 * T + (i if zoom else 0)], of_lens, source])
        yield Term(unknowns, matrix, np.append(local[:m, m], across[:, m]))


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


def scale_direction(cam_from_world: np.ndarray, diagonal: np.ndarray) -> np.ndarray:
    """Step of all unknowns that scales the world, which changes no residual: (translation, 0) of every pose.

    Frames without matches, whose `diagonal` is 0, are left out: their scale could offset that of all others at no cost.
    """
    s = np.zeros(len(diagonal))
    s[: 6 * len(cam_from_world)].reshape(-1, 6)[:, :3] = cam_from_world[:, :3, 3]
    s[diagonal == 0] = 0
    return s
