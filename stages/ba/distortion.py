"""Whether the lens has radial distortion: decided by what its coefficients buy on pixels held out of the fit.

The masks are not known yet: they, and all that follows, are made from undistorted frames.
"""

import time
from dataclasses import dataclass, replace

import numpy as np

from stages.ba import classify, dba, held_out, initialise, rotation
from stages.ba.arguments import undistorted
from stages.ba.classify import Statistics
from stages.ba.graph import MIN_MATCHES, FlowGraph, favour_distance, shared_matches, thin_graph
from stages.ba.guesses import Observed, guess
from stages.ba.held_out import Fit
from stages.ba.start import COARSE_PIXELS
from stages.ba.state import FocalPrior, Level, State, Unknowns
from stages.ba.uncertainty import median_residual, solution_covariance

MIN_GAIN = 0.02
"""Share of the held-out cost that a coefficient must save."""
SIGNIFICANT, CERTAIN = 2.0, 3.0
"""The gain, and the shift of a corner, must exceed this many of their standard deviations. That of the gain is taken
from how much the tiles differ. This is too much: a distortion that is there saves most of its cost near the corners."""
MAX_SIGMA = 0.01
"""From this predicted error of the shift of a corner on, a distortion is not observable."""
SUSPECTED_GAIN, SUSPECTED_SHIFT = 0.01, 0.01
"""From this gain or shift on, cameras with a distortion are searched anew, from undistorted matches."""
TRIED = 0.05
"""Shift of a corner, inwards or outwards, from which cameras are searched anew."""
START_FOCAL = 1.05
"""Focal length of the search in image widths; another one is found by the adjustment."""
FINE_PX = (1.0, 0.5)
"""Robust scales of the refinement in px, before that of the noise."""
ITERATIONS = 15


@dataclass(frozen=True)
class Evidence(held_out.Verdict):
    """The verdict on radial distortion: "distorted" or "straight", if it is observable.

    Attributes:
        shift: what the lens moves a corner of the image outwards by, as a share of its distance to the centre;
            shift_sigma: its predicted error.
    """

    shift: float | None = None
    shift_sigma: float | None = None


NOT_TESTED = Evidence("not tested", "the options exclude it")


@dataclass(frozen=True)
class Lens:
    """Coefficients [2] as in `state.State`; None where the image is taken as it is; the evidence for them."""

    coefficients: np.ndarray | None
    evidence: Evidence


def judge(gain: float, gain_sigma: float, shift: float, shift_sigma: float) -> tuple[str, str]:
    """Decision and reason from the numbers of `Evidence`."""
    saved = f"it saves {100 * gain:.1f} +- {100 * gain_sigma:.1f} % of the cost of held-out pixels"
    shifts = f"it would move a corner by {100 * shift:+.2f} % with a predicted error of {100 * shift_sigma:.2f} %"
    if shift_sigma > MAX_SIGMA:
        return "not observable", f"{saved}; {shifts}"
    explains = gain >= max(MIN_GAIN, SIGNIFICANT * gain_sigma) and abs(shift) >= CERTAIN * shift_sigma
    return "distorted" if explains else "straight", f"{saved}; {shifts}"


def find_lens(graph: FlowGraph, prior: FocalPrior, seed: int, assumed: bool = False) -> Lens:
    """Decide about radial distortion from matches without masks, and estimate its coefficients where it is found.

    Args:
        assumed: whether it is taken without a test, if it can be estimated.
    """
    began = time.process_time()
    shared = shared_matches(graph.source, graph.target, graph.weights, graph.T)
    if np.median(np.diagonal(shared, 1)) < MIN_MATCHES:
        return Lens(None, Evidence("not observable", "neighbouring frames share too few confident matches"))
    factor = max(1, int(np.sqrt(len(graph.pixels) / COARSE_PIXELS)))
    coarse = thin_graph(graph, factor)
    statistics = classify.measure(coarse, None, seed)
    if statistics.camera == "near-still":
        seconds = time.process_time() - began
        return Lens(None, Evidence("not observable", "the camera hardly moves", seconds=seconds))
    observed = Observed(coarse, coarse, None, [START_FOCAL * coarse.width], statistics, prior, seed)
    evidence, best = _weigh(observed, len(coarse.pixels) / len(graph.pixels))
    if assumed and evidence.decision != "not observable":
        evidence = replace(evidence, decision="distorted", reason=f"as the options say; {evidence.reason}")
    coefficients = None
    if evidence.decision == "distorted":
        two = replace(_unknowns(statistics), lens=2)
        parts = held_out.halves(coarse)
        richer = held_out.fit(parts, best.state, two, prior, "lens, two coefficients")
        saved, sigma = held_out.gain(coarse, (best, richer))
        free = two if saved >= max(MIN_GAIN, SIGNIFICANT * sigma) else replace(two, lens=1)
        coefficients = _refine(graph, richer.state if free is two else best.state, free, prior).lens
    return Lens(coefficients, replace(evidence, seconds=time.process_time() - began))


def undistorted_graph(graph: FlowGraph, lens: np.ndarray) -> FlowGraph:
    """The graph with pixels and matches freed of a distortion [2] as in `state.State`."""
    pixels, matches = (undistorted(graph, lens, points) for points in (graph.pixels, graph.matches))
    return replace(graph, pixels=pixels, matches=matches.astype(np.float32))


def _weigh(observed: Observed, density: float) -> tuple[Evidence, Fit]:
    """Evidence for a distortion, and the best cameras with one, fitted to half of the tiles."""
    graph, parts = observed.graph, held_out.halves(observed.graph)
    straight = _unknowns(observed.statistics)
    bent = replace(straight, lens=1)

    def fit(state: State, unknowns: Unknowns, swapped: bool = False) -> Fit:
        return held_out.fit(parts[::-1] if swapped else parts, state, unknowns, observed.prior, "lens")

    plain = fit(_start(observed), straight)
    best = fit(replace(plain.state, lens=np.zeros(2)), bent)
    gain, gain_sigma = held_out.gain(graph, (plain, best))
    if gain > SUSPECTED_GAIN or abs(_shift(best)) > SUSPECTED_SHIFT:
        searched = fit(_search(observed, np.copysign(TRIED, _shift(best))), bent)
        best = min((best, searched), key=lambda fit: fit.cost)
        plain = min((plain, fit(replace(best.state, lens=None), straight)), key=lambda fit: fit.cost)
        swapped = fit(plain.state, straight, True), fit(best.state, bent, True)
        gain, gain_sigma = held_out.gain(graph, (plain, best), swapped)
    shift, shift_sigma = _shift(best), float(np.sqrt(density)) * _shift_sigma(graph, best.state, bent)
    decision, reason = judge(gain, gain_sigma, shift, shift_sigma)
    if decision == "distorted" and straight.translation:
        zoomed = fit(plain.state, replace(straight, zoom=True)), fit(best.state, replace(bent, zoom=True))
        if held_out.gain(graph, zoomed)[0] < MIN_GAIN:
            decision, reason = "straight", f"{reason}; a focal length that changes explains as much"
    return Evidence(decision, reason, gain, gain_sigma, MIN_GAIN, shift=shift, shift_sigma=shift_sigma), best


def _unknowns(statistics: Statistics) -> Unknowns:
    """Those of a pinhole that moves or only turns."""
    return Unknowns(focal=True, translation=statistics.camera != "rotating")


def _start(observed: Observed) -> State:
    """The best cameras of a pinhole."""
    if observed.statistics.camera == "rotating":
        return rotation.solve_rotations(observed.graph, observed.prior, None)[0]
    return initialise.choose(guess(observed, observed.graph)).state


def _search(observed: Observed, shift: float) -> State:
    """The best cameras from matches that are undistorted by a guess."""
    lens = np.array([shift, 0.0])
    straight = undistorted_graph(observed.graph, lens)
    return replace(_start(replace(observed, graph=straight, unmasked=straight)), lens=lens)


def _refine(graph: FlowGraph, state: State, unknowns: Unknowns, prior: FocalPrior) -> State:
    """The state refined on all pixels, down to the scale of the noise."""
    if unknowns.translation:
        state = initialise.initial_state(graph, state.cam_from_world, state.focal_px, FINE_PX[0], lens=state.lens)
    else:
        state = replace(state, inverse_depth=np.zeros((graph.T, len(graph.pixels))))
    state, _ = dba.solve(graph, state, [Level(px, ITERATIONS) for px in FINE_PX], unknowns, prior, "lens")
    if unknowns.translation:
        state = initialise.search_depth(graph, state, FINE_PX[-1])
    sharp_px = float(np.clip(held_out.SHARP * median_residual(graph, state), *held_out.SHARP_PX))
    return dba.solve(favour_distance(graph), state, [Level(sharp_px, ITERATIONS)], unknowns, prior, "lens, sharp")[0]


def _shift(fit: Fit) -> float:
    assert fit.state.lens is not None
    return float(fit.state.lens.sum())


def _shift_sigma(graph: FlowGraph, state: State, unknowns: Unknowns) -> float:
    covariance = solution_covariance(graph, state, unknowns)
    size = 7 * graph.T if unknowns.zoom else 6 * graph.T + 1
    return float(np.sqrt(covariance.of(np.append(np.zeros(size), [1.0, 1.0])[None])[0, 0]))
