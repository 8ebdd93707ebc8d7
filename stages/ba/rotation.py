"""The rotation-only camera: rotations and focal length from all edges together; no translation, hence no depth."""

import numpy as np

from stages.ba import dba, twoview
from stages.ba.dba import FocalPrior, Level, State, Step, Unknowns
from stages.ba.graph import MIN_MATCHES, FlowGraph
from stages.shared import lie

FOCALS = np.geomspace(0.6, 2.2, 7)
"""Focal lengths to start from, in image widths; the cost has one sharp minimum between two of them."""
SCHEDULE = (Level(2.0, 10), Level(0.5, 20))


def solve_rotations(graph: FlowGraph, prior: FocalPrior, known_focal_px: float | None) -> tuple[State, list[Step]]:
    """Poses without translation and all inverse depths zero; the focal length is free unless it is known.

    Rotations are chained at each focal length of a list; the chain of lowest cost is adjusted over all edges.
    """
    focals = [known_focal_px] if known_focal_px else (FOCALS * graph.width).tolist()
    starts = [chain_rotations(graph, focal_px) for focal_px in focals]
    costs = [dba.robust_cost(graph, dba.errors_px(graph, start), SCHEDULE[0].sigma_px) for start in starts]
    unknowns = Unknowns(focal=known_focal_px is None, translation=False)
    return dba.solve(graph, starts[int(np.argmin(costs))], SCHEDULE, unknowns, prior, "rotations")


def chain_rotations(graph: FlowGraph, focal_px: float) -> State:
    """Rotations of consecutive pairs, chained; a pair without matches repeats the rotation of the pair before."""
    cam_from_world = np.tile(np.eye(4), (graph.T, 1, 1))
    R = np.eye(3)
    for i in range(graph.T - 1):
        x, y, w = twoview.pair_rays(graph, i, i + 1, focal_px)
        if len(x) >= MIN_MATCHES:
            R, _ = twoview.fit_rotation(x, y, w, focal_px)
        cam_from_world[i + 1] = lie.from_parts(R, np.zeros(3)) @ cam_from_world[i]
    return State(cam_from_world, np.zeros((graph.T, len(graph.pixels))), focal_px)
