"""The focal length of a long path before there is a path: that of the part where the flow is longest."""

from dataclasses import replace

from stages.ba import initialise
from stages.ba.graph import cut_out
from stages.ba.guesses import Observed, guess
from stages.ba.part import FRAMES, best_part, flow_px
from stages.ba.refinement import CONSISTENT_SHARE, FINE_PX, WEAK_FOCAL, consistent_share
from stages.ba.state import Level, Unknowns
from stages.ba.uncertainty import focal_sigma

ITERATIONS = 15


def focals_of_part(observed: Observed) -> list[float]:
    """The focal length, px, of the part of a long path where the flow is longest; those to try where it is not seen.

    A chain of many pairs at a wrong focal length drifts by so much in scale that no adjustment takes it back in a few
    steps: 1000 frames at 1.17 times the right one, by a factor of 48.
    """
    graph = observed.graph
    if graph.T <= FRAMES:
        return list(observed.focals_px)
    inside = best_part(flow_px(graph))
    part = cut_out(graph, inside)
    best = initialise.choose(guess(replace(observed, graph=part, unmasked=part, previous=None), part))
    levels = [Level(sigma_px, ITERATIONS) for sigma_px in FINE_PX]
    found = initialise.adjust(part, best.state, levels, Unknowns(focal=True), observed.prior, "part, focal").state
    if not consistent_share(part, found) >= CONSISTENT_SHARE or focal_sigma(part, found) > WEAK_FOCAL:
        return list(observed.focals_px)
    return [found.focal_px]
