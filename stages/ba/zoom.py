"""Whether the focal length changes over the frames: decided by what it buys on pixels held out of the fit."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stages.ba import held_out, initialise, twoview
from stages.ba.graph import MIN_MATCHES, FlowGraph
from stages.ba.proposal import DENSE_FRAMES
from stages.ba.state import FocalPrior, State, Unknowns
from stages.ba.uncertainty import solution_covariance
from stages.shared import lie

MIN_GAIN = 0.03
"""Share of the held-out cost of a usual tile that a changing focal length must save."""
CLEAR = 4.0
"""The gain must exceed this many of its standard errors, as tiles that a mover covers together are not independent."""
SIGNIFICANT = 3.0
"""The change of the focal length must exceed this many of its standard deviations."""
MAX_SIGMA = 0.08
"""From this predicted relative error on, a change of the focal length is not observable."""
HIDDEN = 4.0
"""From this many times MAX_SIGMA on, for the first cameras with a change, no others are searched: with better cameras
the error falls to about a quarter at most (.055 to .013 on zoom_station, the most of the tuned scenes)."""
SUSPECTED_GAIN, SUSPECTED_CHANGE = 0.01, 0.02
"""From this gain or this change on, cameras with a changing focal length are searched anew, from pairs of frames."""
SMOOTHED = 2
"""A change from frame to frame is the median over this many more on both sides."""
COMPARED = 100
"""At most so many frames, spread over the sequence, are compared for the predicted error of a change."""
ONE, PER_FRAME = Unknowns(focal=True), Unknowns(focal=True, zoom=True)


@dataclass(frozen=True)
class Evidence(held_out.Verdict):
    """The verdict on a changing focal length: "changing" or "constant", if it is observable.

    Attributes:
        change: log of the largest over the smallest focal length, if it changes; change_sigma: its predicted error.
    """

    change: float | None = None
    change_sigma: float | None = None


NOT_TESTED = Evidence("not tested", "the camera does not move, its focal length is given, or the options exclude it")


def explains(gain: float, gain_sigma: float) -> bool:
    """Whether a changing focal length saves enough of the held-out cost, and not by chance."""
    return gain >= max(MIN_GAIN, CLEAR * gain_sigma)


def judge(gain: float, gain_sigma: float, change: float, change_sigma: float) -> tuple[str, str]:
    """Decision and reason from the numbers of `Evidence`."""
    saved = f"it saves {100 * gain:.1f} +- {100 * gain_sigma:.1f} % of the cost of held-out pixels"
    changes = f"it would change by {100 * np.expm1(change):.1f} % with a predicted error of {100 * change_sigma:.1f} %"
    saves = explains(gain, gain_sigma)
    if change_sigma > MAX_SIGMA or (saves and change < SIGNIFICANT * change_sigma):
        return "not observable", f"{saved}; {changes}"
    return ("changing", saved) if saves else ("constant", f"{saved}; {changes}")


def weigh(
    graph: FlowGraph,
    fixed: State,
    search: Callable[[], Sequence[State]],
    prior: FocalPrior,
    density: float = 1.0,
    assumed: bool = False,
) -> tuple[Evidence, State]:
    """Evidence for a changing focal length, and the best cameras with one, fitted to half of the tiles.

    Args:
        fixed: the best cameras with one focal length; search: finds others to begin from, if there is a suspicion.
        density: pixels of `graph` over those of the graph that the final cameras are fitted to. assumed: whether the
            cameras with a change are wanted even if it is not observable.
    """

    def sigma(fit: held_out.Fit) -> float:
        return float(np.sqrt(density)) * _change_sigma(graph, fit.state)

    began = time.process_time()
    parts = held_out.halves(graph)
    one = held_out.fit(parts, fixed, ONE, prior, "zoom")
    long = graph.T > DENSE_FRAMES
    best = held_out.fit(parts, one.state if long else fixed, PER_FRAME, prior, "zoom")
    # Many focal lengths from cameras at a wrong one may not reach the right ones; and noise is in the range of many.
    suspected = not long and _change(graph, best.state) > SUSPECTED_CHANGE
    pairs = [(one, best)]
    suspected = suspected or held_out.usual_gain(graph, *pairs)[0] > SUSPECTED_GAIN
    if suspected and (assumed or sigma(best) <= HIDDEN * MAX_SIGMA):
        pairs = _anew(graph, pairs[0], search(), prior)
        best = pairs[0][1]
    gain, gain_sigma = held_out.usual_gain(graph, *pairs)
    change, change_sigma = _change(graph, best.state), sigma(best)
    decision, reason = judge(gain, gain_sigma, change, change_sigma)
    seconds = time.process_time() - began
    return Evidence(decision, reason, gain, gain_sigma, MIN_GAIN, seconds, change, change_sigma), best.state


def _anew(
    graph: FlowGraph, first: tuple[held_out.Fit, held_out.Fit], begun: Sequence[State], prior: FocalPrior
) -> list[tuple[held_out.Fit, held_out.Fit]]:
    """The best cameras with one focal length and with many, fitted to one half of the tiles and to the other.

    Args:
        first: those that are known. begun: others to begin from.
    """
    parts, (one, best) = held_out.halves(graph), first
    others = [held_out.fit(parts, state, PER_FRAME, prior, "zoom") for state in begun]
    best = max((best, *others), key=lambda fit: held_out.usual_gain(graph, (one, fit), fitted=True)[0])
    # A better path may have been found, whose gain is not that of its focal lengths.
    again = held_out.fit(parts, replace(best.state, zoom=None), ONE, prior, "zoom")
    if held_out.usual_gain(graph, (one, again), fitted=True)[0] > 0:
        one = again
    other = parts[::-1]
    one_of_other = held_out.fit(other, one.state, ONE, prior, "zoom")
    return [(one, best), (one_of_other, held_out.fit(other, best.state, PER_FRAME, prior, "zoom"))]


def of_turning(graph: FlowGraph, state: State, noise_px: float) -> Evidence:
    """The decision about a camera that turns and zooms, whose rotations `state` explain the flow to the noise.

    A camera that moves along its axis before a plane across it has the flow of a zoom. But if it turns by an angle, it
    would see the plane at an angle: near the border that changes the flow by the angle times that of the zoom.
    """
    rotations = state.cam_from_world[_seen(graph), :3, :3]
    turned = float(np.linalg.norm(lie.log_so3(rotations @ rotations[0].T), axis=1).max())
    change = _change(graph, state)
    seen_px = turned * change * graph.long_side_px / 2
    said = f"turns by {np.rad2deg(turned):.1f} degrees and a change by {100 * np.expm1(change):.1f} % explain the flow"
    apart = f"a dolly before a plane differs from it by {seen_px:.2f} px, at a noise of {noise_px:.2f} px"
    decision = "changing" if seen_px > SIGNIFICANT * noise_px else "not observable"
    return Evidence(decision, f"{said}; {apart}", change=change)


def curve_of_pairs(graph: FlowGraph, focal_px: float, step: int, threshold_px: float, seed: int) -> np.ndarray:
    """Zoom [T] as in `state.State`, from the epipolar geometry of pairs of frames `step` apart at a focal length in px.

    A pair without matches or motion has the change of its neighbours.
    """
    rates = np.full(graph.T - 1, np.nan)
    for i, j in initialise.pair_chain(graph, step):
        rays = twoview.pair_rays(graph, i, j, focal_px)
        motion = twoview.estimate_motion(*rays, focal_px, threshold_px, seed)
        if motion is not None and len(rays[0]) >= MIN_MATCHES:
            rates[i:j] = np.log(twoview.zoom_ratio(motion, *rays, threshold_px, focal_px)) / (j - i)
    known = np.flatnonzero(np.isfinite(rates))
    if not len(known):
        return np.ones(graph.T)
    filled = np.interp(np.arange(graph.T - 1), known, rates[known])
    reach = range(graph.T - 1)
    smooth = [np.median(filled[max(k - SMOOTHED * step, 0) : k + SMOOTHED * step + 1]) for k in reach]
    logs = np.append(0.0, np.cumsum(smooth))
    return np.asarray(np.exp(logs - logs.mean()))


def _seen(graph: FlowGraph) -> np.ndarray:
    """The frames [n] that matches tell something about: the others have what the prior makes of their neighbours."""
    seen = np.flatnonzero(graph.observed_frames())
    return seen if len(seen) else np.arange(graph.T)


def _change(graph: FlowGraph, state: State) -> float:
    return float(np.ptp(np.log(state.focals_px[_seen(graph)])))


def _change_sigma(graph: FlowGraph, state: State) -> float:
    """The largest predicted error of the ratio of two frames' focal lengths."""
    seen = _seen(graph)
    seen = seen[np.unique(np.linspace(0, len(seen) - 1, COMPARED).astype(int))]
    of_focals = np.zeros((len(seen), 7 * graph.T))
    of_focals[np.arange(len(seen)), 6 * graph.T + seen] = 1.0
    covariance = solution_covariance(graph, state, PER_FRAME).of(of_focals)
    variances = np.diagonal(covariance)
    return float(np.sqrt((variances[:, None] + variances - 2 * covariance).max()))
