"""Whether a camera path at another focal length fits better: the adjustment may stand in a local minimum.

Where the camera turns, a path of another shape makes up for a wrong focal length: in a room seen by a slow dolly that
pans, one 12 % too long, with near furniture among the outliers of the robust kernel. From there no adjustment of poses
and focal length leads back, at any scale of the kernel: the path has to be chained anew at another focal length.
"""

from collections.abc import Sequence

import numpy as np

from stages.ba import dba, initialise
from stages.ba.graph import FlowGraph, cut_out, thin_graph, thinning, without_loops
from stages.ba.guesses import ENOUGH, MAX_PAIR_PX, Observed
from stages.ba.initialise import COST_MARGIN, Candidate, Hypothesis
from stages.ba.part import FRAMES, best_part, flow_px
from stages.ba.refinement import CONSISTENT_SHARE, FINE_PX, SHARP, SHARP_PX, consistent_share
from stages.ba.state import Level, State, Unknowns
from stages.ba.uncertainty import median_residual

RATIOS = (0.8, 1.25)
"""Other focal lengths to try, over that of the adjusted guess: in that room 0.7 to 1.05 of the right one lead to it."""
PIXELS = 150
"""They are compared on a grid of about this many pixels per frame."""
ITERATIONS = 15


def better_focal(observed: Observed, coarse: FlowGraph, best: Candidate) -> float | None:
    """The focal length in px of a path that clearly costs less than `best`, each adjusted with its own; None if none.

    It costs less by more than COST_MARGIN at the wide scales of the refinement, and no more at the scale of the noise:
    there alone a path that bends to take in a mover costs more than the right one. Without masks it must explain as
    many matches as the refinement asks for before it frees the focal length. Of a long path this is told from the part
    where the flow is longest.

    Args:
        coarse: the graph on which paths are chained.
    """
    graph, path = observed.graph, best.state.cam_from_world
    if graph.T > FRAMES:
        inside = best_part(flow_px(graph))
        graph, coarse, path = cut_out(graph, inside), cut_out(coarse, inside), path[inside]
    graph = thin_graph(without_loops(graph), thinning(graph, PIXELS))

    free = Unknowns(focal=True)
    start = adjusted(observed, graph, path, best.state.focal_px, FINE_PX, free)
    sharp_px = float(np.clip(SHARP * median_residual(graph, start), *SHARP_PX))
    limits = _costs(graph, start, sharp_px) * ([1 - COST_MARGIN] * len(FINE_PX) + [1])
    found: list[tuple[float, float]] = []
    for ratio in RATIOS:
        focal_px = ratio * start.focal_px
        state = adjusted(observed, graph, chained(observed, coarse, focal_px), focal_px, FINE_PX, free)
        costs = _costs(graph, state, sharp_px)
        if (costs < limits).all() and (observed.masked or consistent_share(graph, state) >= CONSISTENT_SHARE):
            found.append((float(costs[-1]), state.focal_px))
    return min(found)[1] if found else None


def chained(observed: Observed, graph: FlowGraph, focal_px: float) -> np.ndarray:
    """Poses [T, 4, 4] chained from pairs of neighbours of a graph at a focal length."""
    hypothesis = Hypothesis(focal_px, min(observed.threshold_px / 2, MAX_PAIR_PX))
    return initialise.chain(graph, hypothesis, observed.seed)


def adjusted(
    observed: Observed,
    graph: FlowGraph,
    cam_from_world: np.ndarray,
    focal_px: float,
    scales_px: Sequence[float],
    unknowns: Unknowns,
) -> State:
    """Poses [T, 4, 4] adjusted from a focal length on, at one robust scale after the other."""
    state = initialise.initial_state(graph, cam_from_world, focal_px, scales_px[0])
    levels = [Level(sigma_px, ITERATIONS, ENOUGH) for sigma_px in scales_px]
    return initialise.adjust(graph, state, levels, unknowns, observed.prior, "another focal length").state


def _costs(graph: FlowGraph, state: State, sharp_px: float) -> np.ndarray:
    """Robust cost at every scale of the refinement, the last of which is that of the noise."""
    errors = dba.errors_px(graph, state)
    return np.array([dba.robust_cost(graph, errors, sigma_px) for sigma_px in (*FINE_PX, sharp_px)])
