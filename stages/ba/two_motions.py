"""Two rigid motions at once, where a large mover shares wrong cameras with the world: it travels along, or comes.

What keeps nearly the velocity of the camera stays at its place in the image and looks like something static and far
away, before cameras of another path and focal length. These fit mover and world to some tenths of a pixel, at a lower
cost than the right ones at any robust scale, and no adjustment leads away from them. At the scale of the noise they fit
half of each. So the motion of a part of the image is taken, and that of all that it leaves: where one part holds the
mover alone, each fits its own pixels, nearly all of them, and hardly any of the other's.

What comes the other way looks like something static and near. Cameras that fit it, and what is far, leave the ground
before the camera: a step aside of a hand would move what is near by more. So the nearest of what they fit is left out.

Cameras that fit two motions at once fit neither to the scale of the noise. Those of the world fit what both fit closer.
"""

from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from stages.ba import dba, initialise
from stages.ba.graph import MIN_WEIGHT, FlowGraph, thin_graph, thinning
from stages.ba.state import FocalPrior, Level, State, Unknowns

PIXELS = 150
"""Motions are told apart on a grid of about this many pixels per frame, and not on fewer."""
SHARP_PX = 0.2
"""Scale in px up to which the matches of a pixel fit: flow where there is texture has half of that."""
AGREEING = 0.6
"""Share of its matches, by weight, that must fit for a pixel to fit."""
EXPLAINED = 0.85
"""If the cameras found fit this share of the pixels, no mover that travels along is looked for."""
GAIN = 0.1
"""Two motions explain, each for itself, so much more of the pixels than the cameras found; where the image border tells
a pair, one of them explains so much more of that."""
TOGETHER = 0.4
"""Two motions explain at least this share of the pixels, each for itself: wrong pairs of smeared crowds .1 to .36."""
OVERLAP = 0.5
"""Largest share of the pixels of either motion that the other one fits too."""
LEFT = 0.5
"""Share of the pixels that the cameras found leave, which two motions explain."""
CLOSER, QUANTILE = 0.87, 0.9
"""A motion of two may be that of the world if the errors of what it and the cameras found both fit are, at this
quantile, less than so much of those under the cameras found. Beside right ones it was .95 and more, but for pictures
that a rolling shutter bends."""
LESS = 0.05
"""Such a motion explains at most so much less of the image border than the cameras found."""
FAR = 0.3
"""Share of the pixels that the cameras found fit, the farthest of them, without all that may come the other way."""
SAME = 0.8
"""Cameras that fit this share of the pixels of a motion, or of all that either fits, have found it."""
WIDE = (Level(1.0, 8, 1e-3), Level(0.4, 8, 1e-3))
"""The adjustment to a part of the image."""
NARROW, STEPS = (Level(0.3, 5, 1e-3),), 3
"""The adjustment to the pixels that fit, and how often these are chosen anew (`stages.ba.trim`)."""


class Motion(NamedTuple):
    """Cameras of a rigid motion, and the pixels [T, P] that fit them."""

    state: State
    fits: np.ndarray


class Pair(NamedTuple):
    """A motion and that of what it leaves, with the share of the matched pixels that one of them alone explains."""

    first: Motion
    second: Motion
    share: float


def parts(graph: FlowGraph) -> list[np.ndarray]:
    """Parts [P] of the image, in one of which a mover may be nearly alone: halves, the middle, and the sides."""
    u, v = ((graph.pixels + 0.5) / (graph.width, graph.height / graph.aspect)).T
    sides = np.minimum(u, 1 - u) < 0.25
    return [v > 0.5, u > 0.5, u < 0.5, ~sides, sides, v < 0.5]


def background(plain: FlowGraph, masked: FlowGraph, found: State, prior: FocalPrior) -> Motion | None:
    """The motion of the background if the cameras `found` mix it with a mover's; None if they do not, or nothing tells.

    Of two motions the background's covers more of the image border, since objects stand in front of it. Cameras that
    were found with masks and fit it are kept; without masks the refinement may still take in the mover.

    Args:
        plain: the observations without masks; masked: with those with which the cameras were found, on the same pixels;
            without masks the same object.

    Returns:
        cameras, with depths at the pixels of `plain`, and which of these fit.
    """
    if len(plain.pixels) < PIXELS:
        return None
    factor = thinning(plain, PIXELS)
    graph, used = thin_graph(plain, factor), thin_graph(masked, factor)
    matched, along = matched_pixels(graph), border(graph)
    if not (matched & along).any():
        return None
    start = initialise.initial_state(used, found.cam_from_world, found.focal_px, zoom=found.zoom)
    mixed = _adjusted(used, start, WIDE, prior)
    single = Motion(mixed, fitting(graph, mixed))
    motion = _of_two(graph, single, replace(start, zoom=None), prior, matched, along)
    if motion is None:
        return None
    world = motion.fits & matched
    if masked is not plain and (single.fits & world).sum() >= SAME * world.sum():
        return None
    whole = initialise.initial_state(plain, motion.state.cam_from_world, motion.state.focal_px, SHARP_PX)
    return Motion(whole, fitting(plain, whole) & matched_pixels(plain))


def _of_two(
    graph: FlowGraph, single: Motion, start: State, prior: FocalPrior, matched: np.ndarray, along: np.ndarray
) -> Motion | None:
    """The motion of two that is the background's if the cameras found, with what they fit, mix both; else None."""
    alone = share(single.fits, matched)
    looked_at = parts(graph) if alone < EXPLAINED else []
    found = [_pair(graph, part, start, prior, matched, single.fits) for part in looked_at]
    pairs = [pair for pair in found if pair]
    best = max(pairs, key=lambda pair: pair.share, default=None)
    if best and best.share >= max(alone + GAIN, TOGETHER) and _overlap(best, matched) <= OVERLAP:
        return _of_border(best, matched & along)
    far = _without_near(graph, single.state, single.fits & matched)
    near = _pair(graph, far, start, prior, matched, single.fits)
    if near and _explain_more(near, single.fits, matched, along):
        return _of_border(near, matched & along)
    return _closer(graph, [*pairs, near] if near else pairs, single, matched, along)


def matched_pixels(graph: FlowGraph) -> np.ndarray:
    """Which pixels [T, P] have confident matches, on average over the edges of their frame."""
    weights = np.zeros((graph.T, len(graph.pixels)))
    np.add.at(weights, graph.source, graph.weights)
    return np.asarray(weights > MIN_WEIGHT * np.diff(graph.pointer)[:, None])


def _overlap(pair: Pair, matched: np.ndarray) -> float:
    """Share of the pixels of the smaller of two motions that the other one fits too."""
    first, second = (motion.fits & matched for motion in pair[:2])
    return float((first & second).sum() / max(1, min(first.sum(), second.sum())))


def _without_near(graph: FlowGraph, state: State, fits: np.ndarray) -> np.ndarray:
    """All pixels [T, P] but the nearest of those that fit the cameras of a state."""
    inverse_depth = initialise.search_depth(graph, state, SHARP_PX).inverse_depth
    return ~(fits & (inverse_depth > np.quantile(inverse_depth[fits], FAR))) if fits.any() else ~fits


def _of_border(pair: Pair, at_border: np.ndarray) -> Motion:
    """The motion that fits more of the pixels at the border."""
    return max(pair[:2], key=lambda motion: share(motion.fits, at_border))


def _explain_left(pair: Pair, single: np.ndarray, matched: np.ndarray) -> bool:
    """Whether two motions together explain what the cameras found leave. What is far fits both."""
    together, alone = share(pair.first.fits | pair.second.fits, matched), share(single, matched)
    return together - alone >= LEFT * (1 - alone)


def _explain_more(pair: Pair, single: np.ndarray, matched: np.ndarray, along: np.ndarray) -> bool:
    """Whether two motions together explain what the cameras found leave, and one of them more of the image border."""
    at_border = max(share(motion.fits, matched & along) for motion in pair[:2])
    return _explain_left(pair, single, matched) and at_border >= share(single, matched & along) + GAIN


def _closer(
    graph: FlowGraph, pairs: list[Pair], found: Motion, matched: np.ndarray, along: np.ndarray
) -> Motion | None:
    """Of the motions that fit closer than the cameras found, the one that fits most pixels; None if none does.

    They are of pairs that explain what the cameras found leave, and fit the border about as well: what a rolling
    shutter bends, cameras fit closer in a part of the view.
    """
    enough = share(found.fits, matched & along) - LESS
    explaining = [pair for pair in pairs if _explain_left(pair, found.fits, matched)]
    motions = [motion for pair in explaining for motion in pair[:2] if share(motion.fits, matched & along) >= enough]
    closer = [motion for motion in motions if _errors_over(graph, motion, found, matched) < CLOSER]
    return max(closer, key=lambda motion: share(motion.fits, matched), default=None)


def _errors_over(graph: FlowGraph, motion: Motion, found: Motion, matched: np.ndarray) -> float:
    """Errors under a motion over those under the cameras found, of matches that fit both; 1 without any error."""
    common = (motion.fits & found.fits & matched)[graph.source] & (graph.weights > MIN_WEIGHT)
    if not common.any():
        return 1.0
    errors = (
        dba.errors_px(graph, initialise.search_depth(graph, of.state, SHARP_PX))[common] for of in (motion, found)
    )
    closer, before = (float(np.quantile(of, QUANTILE)) for of in errors)
    return closer / before if before > 0 else 1.0


def _pair(
    graph: FlowGraph, part: np.ndarray, start: State, prior: FocalPrior, matched: np.ndarray, single: np.ndarray
) -> Pair | None:
    """The motion of a part, [P] or [T, P], of the image, and that of what does not fit it.

    None if the first is that of the pixels `single` [T, P], which the cameras found fit: one of a pair is not.
    """
    first = _motion(graph, np.broadcast_to(part, matched.shape), start, prior)
    if (first.fits & single & matched).sum() >= SAME * ((first.fits | single) & matched).sum():
        return None
    second = _motion(graph, ~smooth(graph, first.fits), start, prior)
    return Pair(first, second, share(first.fits ^ second.fits, matched))


def _motion(graph: FlowGraph, chosen: np.ndarray, start: State, prior: FocalPrior) -> Motion:
    """The motion of the pixels `chosen` [T, P], then of all that fit it."""
    part = _of(graph, chosen)
    searched = initialise.initial_state(part, start.cam_from_world, start.focal_px)
    state = _adjusted(part, searched, WIDE, prior)
    fits = fitting(graph, state)
    for _ in range(STEPS):
        part = _of(graph, fits)
        state = _adjusted(part, initialise.search_depth(part, state, NARROW[0].sigma_px), NARROW, prior)
        fits = fitting(graph, state)
    return Motion(state, fits)


def _of(graph: FlowGraph, chosen: np.ndarray) -> FlowGraph:
    """The graph with the matches of the pixels `chosen` [T, P] alone."""
    return replace(graph, weights=graph.weights * chosen[graph.source])


def _adjusted(graph: FlowGraph, state: State, levels: tuple[Level, ...], prior: FocalPrior) -> State:
    unknowns = Unknowns(focal=True, zoom=state.zoom is not None)
    return initialise.adjust(graph, state, levels, unknowns, prior, "two motions").state


def fitting(graph: FlowGraph, state: State) -> np.ndarray:
    """Which pixels [T, P] fit the cameras of a state at some depth, to the scale of the noise."""
    errors = dba.errors_px(graph, initialise.search_depth(graph, state, SHARP_PX))
    return dba.fitting_pixels(graph, errors, SHARP_PX, AGREEING)


def smooth(graph: FlowGraph, chosen: np.ndarray) -> np.ndarray:
    """Pixels [T, P] without isolated ones."""
    maps = chosen.reshape(graph.T, graph.rows, graph.columns).astype(np.uint8)
    return np.stack([cv2.medianBlur(frame, 3) for frame in maps]).reshape(chosen.shape) > 0


def share(chosen: np.ndarray, among: np.ndarray) -> float:
    """Share of the pixels `among` [T, P] that are chosen."""
    return float((chosen & among).sum() / max(1, among.sum()))


def border(graph: FlowGraph, width: int = 1) -> np.ndarray:
    """Pixels [P] along the image border, `width` of them deep."""
    along = np.ones((graph.rows, graph.columns), bool)
    along[width:-width, width:-width] = False
    return along.ravel()
