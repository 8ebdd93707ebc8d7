"""A path at another focal length, where one camera motion is found for large movers and the ground together.

Movers that travel along with the camera and fill much of the view share cameras of too long a lens with the ground:
these fit more of the matches than the right ones do, which fit the ground alone, and from there no adjustment leads
back. At the right focal length a chain of pairs leads to cameras that fit far more of the image border, and shake less.
"""

from stages.ba import initialise
from stages.ba.graph import FlowGraph, thin_graph, thinning
from stages.ba.guesses import Observed
from stages.ba.initialise import Candidate, roughness
from stages.ba.other_focals import adjusted, chained
from stages.ba.refinement import FINE_PX
from stages.ba.state import State, Unknowns
from stages.ba.two_motions import PIXELS, SHARP_PX, Motion, border, fitting, matched_pixels, share

MORE, FOLLOWED = 0.15, 0.8
"""Another path counts if it is no rougher and fits so much more of the matched pixels along the image border; where the
cameras found fit this share of them, none is looked for. Three clips of large movers: .29 to .42 more. In 74 others,
with right cameras and with wrong ones, none that is no rougher fits more by more than .03."""
FOCALS = (0.55, 0.62, 0.69, 0.77, 0.86, 0.97, 1.25, 1.5)
"""Focal lengths, in longer sides of the image, at which paths are chained."""
SCALES_PX = (*FINE_PX, SHARP_PX)
"""Robust scales of their adjustment, down to that of the noise."""


def border_path(observed: Observed, plain: FlowGraph, used: FlowGraph, best: Candidate) -> Motion | None:
    """The motion of a path that is no rougher than `best` and follows more of the image border; None if there is none.

    Args:
        plain: the observations without masks; used: those on which `best` was found, on the same pixels.

    Returns:
        cameras, with depths at the pixels of `plain`, and which of these fit.
    """
    if best.state.zoom is not None or len(plain.pixels) < PIXELS:
        return None
    factor = thinning(plain, PIXELS)
    graph, found = thin_graph(plain, factor), best.state
    along = matched_pixels(graph) & border(graph)
    if not along.any():
        return None
    used, free = thin_graph(used, factor), Unknowns(focal=True)
    start = adjusted(observed, used, found.cam_from_world, found.focal_px, SCALES_PX, free)
    most_rough, followed = roughness(start.cam_from_world, graph.times_s), share(fitting(graph, start), along)
    if followed > FOLLOWED:
        return None
    least = followed + MORE
    others: list[tuple[float, State]] = []
    for sides in FOCALS:
        focal_px = sides * graph.long_side_px
        state = adjusted(observed, graph, chained(observed, plain, focal_px), focal_px, SCALES_PX, Unknowns())
        followed = share(fitting(graph, state), along)
        if roughness(state.cam_from_world, graph.times_s) <= most_rough and followed >= least:
            others.append((followed, state))
    if not others:
        return None
    state = max(others, key=lambda one: one[0])[1]
    whole = initialise.initial_state(plain, state.cam_from_world, state.focal_px, SHARP_PX)
    return Motion(whole, fitting(plain, whole) & matched_pixels(plain))
