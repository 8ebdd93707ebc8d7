"""The rotation-only camera: rotations and focal length from all edges together; no translation, hence no depth."""

import numpy as np

from stages.ba import dba, twoview
from stages.ba.graph import MIN_MATCHES, FlowGraph
from stages.ba.state import FocalPrior, Level, State, Step, Unknowns
from stages.ba.weights import downweight_border
from stages.shared import lie

FOCALS = np.geomspace(0.6, 2.2, 7)
"""Focal lengths to start from, in longer sides of the image; the cost has one sharp minimum between two of them."""
SCHEDULE = (Level(2.0, 10), Level(0.5, 20))


def solve_rotations(
    graph: FlowGraph, prior: FocalPrior, known_focal_px: float | None, zoom: bool = False
) -> tuple[State, list[Step]]:
    """Poses without translation and all inverse depths zero; the focal length is free unless it is known.

    Rotations are chained at each focal length of a list; the chain of lowest cost is adjusted over all edges. With
    `zoom` every frame has a focal length of its own. Pixels at the border of the image count little in the adjustment.
    """
    focals = [known_focal_px] if known_focal_px else (FOCALS * graph.long_side_px).tolist()
    starts = [chain_rotations(graph, focal_px, zoom) for focal_px in focals]
    costs = [dba.robust_cost(graph, dba.errors_px(graph, start), SCHEDULE[0].sigma_px) for start in starts]
    unknowns = Unknowns(focal=known_focal_px is None, translation=False, zoom=zoom)
    return dba.solve(downweight_border(graph), starts[int(np.argmin(costs))], SCHEDULE, unknowns, prior, "rotations")


def chain_rotations(graph: FlowGraph, focal_px: float, zoom: bool = False) -> State:
    """Rotations of consecutive pairs, chained; a pair without matches repeats the rotation of the pair before.

    With `zoom` the ratios of the focal lengths of the pairs are chained too.
    """
    cam_from_world, focals_px = np.tile(np.eye(4), (graph.T, 1, 1)), np.full(graph.T, focal_px)
    R, ratio = np.eye(3), 1.0
    for i in range(graph.T - 1):
        here_px = float(focals_px[i])
        x, y, w = twoview.pair_rays(graph, i, i + 1, here_px)
        if len(x) >= MIN_MATCHES and zoom:
            R, ratio = twoview.fit_turn_and_zoom(x, y, w, here_px)
        elif len(x) >= MIN_MATCHES:
            R, _ = twoview.fit_rotation(x, y, w, here_px)
        cam_from_world[i + 1] = lie.from_parts(R, np.zeros(3)) @ cam_from_world[i]
        focals_px[i + 1] = here_px * ratio
    mean_px = float(np.exp(np.log(focals_px).mean())) if zoom else focal_px
    no_depth = np.zeros((graph.T, len(graph.pixels)))
    return State(cam_from_world, no_depth, mean_px, focals_px / mean_px if zoom else None)
