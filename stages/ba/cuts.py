"""The longest shot of a sequence: the largest set of frames linked by matches. Cuts and blank frames end a shot."""

from dataclasses import replace

import numpy as np
from scipy.sparse.csgraph import connected_components

from stages.ba.estimate import estimate
from stages.ba.graph import MIN_MATCHES, FlowGraph, cut_out, shared_matches
from stages.ba.guesses import PoseGuess
from stages.ba.options import BAOptions
from stages.ba.problem import Estimate, Problem
from stages.shared import lie
from stages.shared.number_ranges import number_ranges, runs_of

MIN_FRAMES = 3
"""Fewer frames than this are no shot: two frames of noise may match by chance."""
UNKNOWN_VARIANCE = 1e6
"""Variance of the twist of an unobserved pose."""


def linked_frames(source: np.ndarray, target: np.ndarray, weights: np.ndarray, T: int) -> np.ndarray:
    """Which of T frames belong to the longest shot: the largest set linked by pairs with MIN_MATCHES sure matches.

    Args:
        source, target: [E] frame indices; weights: [E, P] confidences of sampled matches, without masks.

    Returns:
        [T] bool; all true if fewer than MIN_FRAMES frames are linked, so that the whole sequence is solved or fails.
    """
    _, label = connected_components(shared_matches(source, target, weights, T) >= MIN_MATCHES, directed=False)
    sizes = np.bincount(label)
    return label == sizes.argmax() if sizes.max() >= MIN_FRAMES else np.ones(T, bool)


def isolate(graph: FlowGraph, frames: np.ndarray) -> FlowGraph:
    """The graph with weight 0 on all edges to or from frames outside `frames` [T] bool."""
    kept = frames[graph.source] & frames[graph.target]
    return replace(graph, weights=graph.weights * kept[:, None])


def estimate_shot(problem: Problem, frames: np.ndarray, options: BAOptions) -> Estimate:
    """The estimate from the frames [T] of one shot; the poses of the others are interpolated.

    Frames before its first and after its last are not used: statistics and gauge are those of the shot.
    """
    if frames.all():
        return estimate(problem, options)
    inside = span(frames)
    previous, unmasked = problem.previous, problem.unmasked
    part = replace(
        problem,
        graph=cut_out(problem.graph, inside),
        previous=previous and _cut_out_guess(previous, inside),
        unmasked=unmasked and cut_out(unmasked, inside),
    )
    return _put_back(estimate(part, options), inside, frames)


def span(frames: np.ndarray) -> slice:
    """From the first to the last frame of a shot [T] bool."""
    return slice(int(np.argmax(frames)), len(frames) - int(np.argmax(frames[::-1])))


def bridge(cam_from_world: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Poses [T, 4, 4] where those not `known` [T] are interpolated at constant velocity, or constant at the ends."""
    at, bridged = np.flatnonzero(known), cam_from_world.copy()
    for k in np.flatnonzero(~known):
        after = int(np.searchsorted(at, k))
        first, last = at[max(after - 1, 0)], at[min(after, len(at) - 1)]
        share = (k - first) / (last - first) if last > first else 0.0
        motion = lie.log_se3(cam_from_world[last] @ lie.inverse(cam_from_world[first]))
        bridged[k] = lie.exp_se3(share * motion) @ cam_from_world[first]
    return bridged


def warnings(frames: np.ndarray, numbers: list[int]) -> list[str]:
    """A warning if only some frames [T] of a sequence with these frame numbers [T] form the shot; else none."""
    if frames.all():
        return []
    parts = [[n for n, kept in zip(numbers, frames, strict=True) if kept == solved] for solved in (True, False)]
    shots = sorted(run for part in parts for run in runs_of(part) if run[1] - run[0] + 1 >= MIN_FRAMES)
    advice = "leave out what shows nothing, and number the frames anew"
    if shots:
        listed = ", ".join(f"[{first}, {last}]" for first, last in shots)
        advice = f"if the clip is cut there, give its shots as in `shots: [{listed}]`; else {advice}"
    return [f"unobserved: too few confident matches join frames {number_ranges(parts[1])} with the others; {advice}"]


def _cut_out_guess(guess: PoseGuess, inside: slice) -> PoseGuess:
    zoom = None if guess.zoom is None else guess.zoom[inside]
    return replace(guess, cam_from_world=guess.cam_from_world[inside], zoom=zoom)


def _put_back(part: Estimate, inside: slice, frames: np.ndarray) -> Estimate:
    """The estimate of the frames `inside` extended to all frames; the others are unobserved."""
    around = inside.start, len(frames) - inside.stop

    def padded(values: np.ndarray) -> np.ndarray:
        return np.pad(values, [around] + [(0, 0)] * (values.ndim - 1), "edge")

    poses = bridge(padded(part.state.cam_from_world), frames)
    inverse_depth = np.ones((len(frames), part.state.inverse_depth.shape[1]))
    inverse_depth[inside] = part.state.inverse_depth
    static = None if part.static is None else padded(part.static)
    covariance = np.where(frames[:, None, None], padded(part.covariance), UNKNOWN_VARIANCE * np.eye(6))
    zoom = None if part.state.zoom is None else padded(part.state.zoom)
    state = replace(part.state, cam_from_world=poses, inverse_depth=inverse_depth, zoom=zoom)
    return replace(part, state=state, covariance=covariance, static=static)
