"""Whether what is nearest moves: a camera that translates shows it along the lower border, where the ground is near.

Movers that travel together past a camera on a tripod look as if it travelled, with all that rests at infinity: one
path explains all of it. But then the ground before it would be at infinity, too.
"""

from dataclasses import replace

import numpy as np

from stages.ba import dba, rotation
from stages.ba.classify import AT_REST, MOVES, STILL_PX
from stages.ba.graph import MIN_WEIGHT, FlowGraph, cut_out, thin_graph, thinning, without_loops
from stages.ba.part import FRAMES
from stages.ba.state import FocalPrior, State
from stages.ba.two_motions import AGREEING, PIXELS, SHARP_PX, border, matched_pixels, share

LOWER = 2 / 3
"""The lower border begins at this share of the height."""
ENOUGH = 12
"""So many matched pixels say something."""
PARTS = 3
"""Parts of a clip; in each the ground must be matched, and rest: a camera may turn first, and then walk."""


def at_rest(graph: FlowGraph, prior: FocalPrior, known_focal_px: float | None) -> float | None:
    """Share of the matched pixels of the lower border that fit a turning camera to the noise; None: too few tell.

    The least of those in the parts of the clip, of pixels that do not stay in the image. A part without matches there
    may hide a walk: then None, too, but where the ground moves in another. Measured without masks: 0 to .001 in 30
    clips whose camera moves, .18 to .95 in four whose camera only turns, movers over up to half of the view in two of
    them, .04 in a fifth where these are at the border.
    """
    plain = without_loops(graph)
    shares, everywhere = [], True
    for inside, parts in _spans(graph.T):
        span = cut_out(plain, inside)
        found = _near(span)
        passing, near = (np.array_split(chosen, parts) for chosen in (_passing(span, found), found))
        everywhere &= all(chosen.sum() >= ENOUGH for chosen in near)
        if any(chosen.sum() >= ENOUGH for chosen in passing):
            turns, _ = rotation.solve_rotations(thin_graph(span, thinning(span, PIXELS)), prior, known_focal_px)
            resting = np.array_split(_resting(span, turns), parts)
            shares += [share(*pair) for pair in zip(resting, passing, strict=True) if pair[1].sum() >= ENOUGH]
    least = min(shares, default=1.0)
    return least if shares and (everywhere or least < MOVES) else None


def share_kept(masked: FlowGraph, plain: FlowGraph) -> float | None:
    """Share of the matches of the lower border that masks leave; None: few are matched, or there are no masks.

    By their weights. Wrong cameras take for a mover what is near. Measured in the last round: .06 and .13 with cameras
    that are wrong for movers over 40 % of the view, .30 and more in 35 other clips, right ones and wrong.
    """
    near = _near(plain)
    if masked is plain or near.sum() < ENOUGH:
        return None
    kept, before = (float(graph.weights[near[graph.source]].sum(dtype=float)) for graph in (masked, plain))
    return kept / before


def _spans(T: int) -> list[tuple[slice, int]]:
    """Frames to look at, and in how many parts: all in PARTS; of a long clip FRAMES in all, spread over it."""
    if T <= FRAMES:
        return [(slice(0, T), PARTS)]
    length = FRAMES // PARTS**2
    return [(slice(int(first), int(first) + length), 1) for first in np.linspace(0, T - length, PARTS**2)]


def share_left(graph: FlowGraph, path: State, turns: State) -> float:
    """What a path leaves of the residual of turns on the lower border, where that fits the turns; 0: little of it does.

    Where the ground rests the path has nothing to explain. A slow camera is seen to move there, by less than SHARP_PX.
    """
    near = _passing(graph, _near(graph))
    resting = near & _resting(graph, turns)
    if near.sum() < ENOUGH or share(resting, near) < AT_REST:
        return 0.0
    chosen = resting[graph.source] & (graph.weights > MIN_WEIGHT)
    path_px, turns_px = (float(np.median(dba.errors_px(graph, state)[chosen])) for state in (path, turns))
    return path_px / max(turns_px, 1e-12)


def _near(graph: FlowGraph) -> np.ndarray:
    """The matched pixels [T, P] of the lower border."""
    low = graph.pixels[:, 1] * graph.aspect >= LOWER * graph.height
    return matched_pixels(graph) & border(graph, thinning(graph, PIXELS)) & low


def _passing(graph: FlowGraph, near: np.ndarray) -> np.ndarray:
    """Those of the pixels `near` [T, P] that do not stay in the image, as the bonnet of a car does."""
    flow_px, weights = np.zeros((2, graph.T, len(graph.pixels)))
    apart = np.abs(graph.target - graph.source)[:, None]
    np.add.at(flow_px, graph.source, graph.weights * np.linalg.norm(graph.matches - graph.pixels, axis=2) / apart)
    np.add.at(weights, graph.source, graph.weights)
    return near & (flow_px > STILL_PX * weights)


def _resting(graph: FlowGraph, turns: State) -> np.ndarray:
    """Which pixels [T, P] fit a camera that turns, found on any grid."""
    turns = replace(turns, inverse_depth=np.zeros((graph.T, len(graph.pixels))))
    return dba.fitting_pixels(graph, dba.errors_px(graph, turns), SHARP_PX, AGREEING)
