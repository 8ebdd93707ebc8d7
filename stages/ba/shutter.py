"""Rolling shutter: rows that are exposed one after the other, each with a camera pose of its own.

The camera at the time of a row is interpolated between the poses of neighbouring frames, which are those of the middle
row. What that changes in a match is computed from the present solution and taken out of it; the adjustment then goes on
as if all rows were exposed at once. One unknown, the readout time of all rows as a share of the frame interval, is
decided by what it buys on pixels held out of the fit.

A camera at constant velocity hardly shows it: the motion within a frame then differs from that between frames only by
the rows that a pixel moves up or down, which depth, focal length and speed make up for.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from stages.ba import held_out, reduced
from stages.ba.graph import MIN_WEIGHT, FlowGraph, cut_out, thin_graph, thinning
from stages.ba.held_out import SHARP, SHARP_PX, Fit
from stages.ba.kernel import MIN_DEPTH_RATIO
from stages.ba.part import FRAMES, best_part, state_of_part
from stages.ba.state import FocalPrior, State, Unknowns
from stages.ba.uncertainty import CORRELATION, MIN_NOISE_PX
from stages.shared.rolling import frame_times, moved_by, path_of

PIXELS = 400
"""The readout is decided on a grid of about this many pixels per frame."""
PROBE, PASSES, TRIES = 0.3, 2, 6
"""The first readout that is tried; corrections of the matches at each; and the most readouts that are tried."""
SETTLED = 0.01
"""A change of the readout below this is none."""
MIN_GAIN = 0.04
"""Share of the held-out cost of a usual tile that a rolling shutter must save."""
SIGNIFICANT = 3.0
"""The gain, and the readout, must exceed this many of their standard deviations."""
MAX_SIGMA = 0.15
"""From this predicted error on, the readout is not observable."""
FAR_FROM_SAVED = 0.5
"""The search stops where the best readout would save less than this share of MIN_GAIN: no other decides otherwise."""


@dataclass(frozen=True)
class Evidence(held_out.Verdict):
    """The verdict on a rolling shutter: "rolling" or "global", if it is observable.

    Attributes:
        readout: time from the first row to the last, in frames; negative if the last row comes first; 0: not known.
        readout_sigma: its predicted error.
    """

    readout: float = 0.0
    readout_sigma: float | None = None


NOT_TESTED = Evidence("not tested", "there are no poses, or the options exclude it")


def row_times(graph: FlowGraph, v: np.ndarray) -> np.ndarray:
    """Time of v of the graph's pixels, of any shape, after the middle row of the image, in units of the readout."""
    return np.asarray(v * graph.aspect / (graph.height - 1) - 0.5)


def shifts(graph: FlowGraph, state: State, readout: float) -> np.ndarray:
    """How far [E, P, 2] px matches move because source pixel and match are exposed at the time of their rows."""
    times, moved = frame_times(graph.T, graph.times_s), np.zeros(graph.matches.shape, np.float32)
    if not readout:
        return moved
    path = path_of(state.cam_from_world, times)
    relative, focals_px = reduced.relative_motions(graph, state.cam_from_world), state.focals_px
    source_times = readout * row_times(graph, graph.pixels[:, 1])
    for i in range(graph.T):
        edges = slice(graph.pointer[i], graph.pointer[i + 1])
        targets, R, d = graph.target[edges, None], relative[edges, :3, :3], state.inverse_depth[i]
        rays = np.column_stack([(graph.pixels - graph.centre) / focals_px[i], np.ones(len(d))])
        turned = moved_by(rays, d, path(times[i]) - path(times[i] + source_times))
        shifted = d[:, None] * relative[edges, None, :3, 3]
        at_once, begun = (points @ np.swapaxes(R, 1, 2) + shifted for points in (rays, turned))
        target_times = readout * row_times(graph, graph.matches[edges, :, 1])
        in_turn = moved_by(begun, d, path(times[targets] + target_times) - path(times[targets]))
        before, after = (_project(points, focals_px[targets, None]) for points in (at_once, in_turn))
        ahead = np.minimum(at_once[..., 2], in_turn[..., 2]) > MIN_DEPTH_RATIO
        moved[edges] = np.where(ahead[..., None], after - before, 0.0)
    return moved


def correct(graph: FlowGraph, state: State, readout: float) -> FlowGraph:
    """The matches as a shutter would show them that exposes all rows at the time of the middle one."""
    return replace(graph, matches=graph.matches - shifts(graph, state, readout))


def resampled(state: State, solved: FlowGraph, graph: FlowGraph) -> State:
    """The state of one graph with inverse depths at the pixels of another."""
    maps = state.inverse_depth.reshape(solved.T, solved.rows, solved.columns)
    return replace(state, inverse_depth=graph.resample(maps, solved.stride))


def _project(points: np.ndarray, focal_px: np.ndarray) -> np.ndarray:
    """Pixels [..., n, 2] about the principal point of scaled points [..., n, 3]."""
    return np.asarray(focal_px * points[..., :2] / np.maximum(points[..., 2:], MIN_DEPTH_RATIO))


def judge(gain: float, gain_sigma: float, readout: float, readout_sigma: float) -> tuple[str, str]:
    """Decision and reason from the numbers of `Evidence`."""
    saved = f"it saves {100 * gain:.1f} +- {100 * gain_sigma:.1f} % of the cost of held-out pixels"
    took = f"would take {readout:.2f} +- {readout_sigma:.2f}" if readout_sigma < 1 else "could take any share"
    words = f"{saved}; the readout {took} of the frame interval"
    if readout_sigma > MAX_SIGMA:
        return "not observable", words
    explains = gain >= max(MIN_GAIN, SIGNIFICANT * gain_sigma)
    return "rolling" if explains and abs(readout) >= SIGNIFICANT * readout_sigma else "global", words


def weigh(graph: FlowGraph, state: State, unknowns: Unknowns, prior: FocalPrior, assumed: bool) -> Evidence:
    """Evidence for a rolling shutter from the best cameras without one.

    Of a long path it is that of the part where the camera shakes most: elsewhere a shutter hardly shows.

    Args:
        unknowns: those of the cameras that were free. assumed: whether it is taken without a test.
    """
    began = time.process_time()
    if graph.T > FRAMES:
        inside = best_part(_shakes(graph, state))
        graph, state = cut_out(graph, inside), state_of_part(state, inside)
    factor = thinning(graph, PIXELS)
    coarse = thin_graph(graph, factor)
    density = len(coarse.pixels) / len(graph.pixels)
    state = resampled(state, graph, coarse)

    def fit(readout: float, state: State, swapped: bool = False) -> Fit:
        for _ in range(PASSES if readout else 1):
            halves = held_out.halves(correct(coarse, state, readout))
            found = held_out.fit(halves[::-1] if swapped else halves, state, unknowns, prior, "shutter")
            state = found.state
        return found

    tried, curvature = _search(coarse, fit, state, 0.0 if assumed else FAR_FROM_SAVED * MIN_GAIN)
    readout = min(tried, key=lambda at: tried[at].cost)
    pairs = [(tried[0.0], tried[readout])]
    if readout:
        pairs.append((fit(0.0, tried[0.0].state, swapped=True), fit(readout, tried[readout].state, swapped=True)))
    gain, gain_sigma = held_out.usual_gain(coarse, *pairs)
    sigma_px = _sharp_scale(tried[readout].errors, held_out.halves(coarse)[1])
    sigma = CORRELATION * max(sigma_px / SHARP, MIN_NOISE_PX) * float(np.sqrt(density / max(curvature, 1e-300)))
    decision, reason = judge(gain, gain_sigma, readout, sigma)
    if assumed:
        decision, reason = "rolling", f"as the options say; {reason}"
    seconds = time.process_time() - began
    return Evidence(decision, reason, gain, gain_sigma, MIN_GAIN, seconds, readout, sigma)


def _shakes(graph: FlowGraph, state: State) -> np.ndarray:
    """How much [T] the motion of the camera changes at a frame: squared, at the median depth, which is 1."""
    times = frame_times(graph.T, graph.times_s)
    twists = np.diff(path_of(state.cam_from_world, times)(times), axis=0)
    return np.pad((np.diff(twists, axis=0) ** 2).sum(axis=1), 1)


def _saved(graph: FlowGraph, tried: dict[float, Fit]) -> float:
    """Share of its cost that the best readout saves on a usual tile by the parabola through those tried; all of it if
    there is none."""
    if len(tried) < 3:
        return 1.0
    gains = [held_out.usual_gain(graph, (tried[0.0], found))[0] for found in tried.values()]
    square, slope, _ = np.polyfit(list(tried), np.negative(gains), 2)
    return float(slope**2 / (4 * square)) if square > 0 else 1.0


def _search(
    graph: FlowGraph, fit: Callable[[float, State], Fit], state: State, least: float
) -> tuple[dict[float, Fit], float]:
    """Fits at the readouts that were tried, 0 and at least one more, and the curvature of the cost at the best, px^2.

    First the lowest cost is bracketed: far from it steps by the derivative of the residuals are too short, as the cost
    is robust. Within the bracket they are taken; cameras at two readouts give the derivative.

    Args:
        least: share of the cost of a usual tile; where the best readout would save less, no more are tried.
    """
    tried, readout = {0.0: fit(0.0, state)}, PROBE
    for _ in range(TRIES):
        nearest = min(tried, key=lambda at: abs(at - readout))
        tried[readout] = fit(readout, tried[nearest].state)
        step, curvature = _step(graph, tried)
        readout = _next({at: found.cost for at, found in tried.items()}, step)
        if any(abs(readout - at) < SETTLED for at in tried) or _saved(graph, tried) < least:
            break
    return tried, curvature


def _next(costs: dict[float, float], step: float) -> float:
    """The readout to try after those of these costs, 0 and PROBE among them.

    Args:
        step: from the best of them, by the derivative of the residuals.
    """
    tried, best = sorted(costs), min(costs, key=lambda at: costs[at])
    k = tried.index(best)
    if k in (0, len(tried) - 1) and abs(best) < 1:  # lower costs may lie beyond
        return float(np.clip(2 * best, -1, 1)) if best else -PROBE
    return float(np.clip(best + step, tried[max(k - 1, 0)], tried[min(k + 1, len(tried) - 1)]))


def _step(graph: FlowGraph, tried: dict[float, Fit]) -> tuple[float, float]:
    """A Gauss-Newton step from the best readout that was tried, and the curvature of the cost there, px^2."""
    fitted, best = held_out.halves(graph)[0], min(tried, key=lambda at: tried[at].cost)
    other = min((at for at in tried if at != best), key=lambda at: abs(at - best))
    now, before = (_residuals(graph, tried[at].state, at) for at in (best, other))
    slope, errors = (now - before) / (best - other), np.linalg.norm(now, axis=2)
    inlier = 1 / (1 + (errors / _sharp_scale(errors, fitted)) ** 2) ** 2
    squared = inlier * (slope**2).sum(axis=2)
    step = (fitted.weights * inlier * (now * slope).sum(axis=2)).sum() / max((fitted.weights * squared).sum(), 1e-300)
    return -float(step), float((graph.weights * squared).sum())


def _residuals(graph: FlowGraph, state: State, readout: float) -> np.ndarray:
    """Residuals [E, P, 2] px of the corrected matches."""
    relative, focals_px = reduced.relative_motions(graph, state.cam_from_world), state.focals_px
    offsets = (graph.pixels - graph.centre) / focals_px[:, None, None]
    rays = np.concatenate([offsets, np.ones((*offsets.shape[:2], 1))], axis=2)[graph.source]
    shifted = state.inverse_depth[graph.source][..., None] * relative[:, None, :3, 3]
    points = rays @ np.swapaxes(relative[:, :3, :3], 1, 2) + shifted
    projected = _project(points, focals_px[graph.target, None, None])
    return np.asarray(correct(graph, state, readout).matches - graph.centre - projected)


def _sharp_scale(errors: np.ndarray, graph: FlowGraph) -> float:
    """Robust scale in px at errors [E, P] in px: twice their median, within limits."""
    sure = graph.weights > MIN_WEIGHT
    return float(np.clip(SHARP * np.median(errors[sure]), *SHARP_PX)) if sure.any() else SHARP_PX[1]
