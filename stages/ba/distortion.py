"""Whether the lens has radial distortion: decided by what its coefficients buy on pixels held out of the fit.

The masks are not known yet: they, and all that follows, are made from undistorted frames.
"""

import time
from dataclasses import dataclass, replace

import numpy as np

from stages.ba import classify, dba, held_out, initialise, rotation, zoom
from stages.ba.arguments import undistorted
from stages.ba.graph import MIN_MATCHES, FlowGraph, shared_matches, thin_graph, thinning
from stages.ba.guesses import MAX_PAIR_PX, Observed, guess
from stages.ba.held_out import Fit
from stages.ba.start import COARSE_PIXELS
from stages.ba.state import FocalPrior, Level, State, Unknowns
from stages.ba.uncertainty import median_residual, solution_covariance
from stages.ba.weights import favour_distance

MIN_GAIN = 0.02
"""Share of the held-out cost that a coefficient must save."""
SIGNIFICANT, CERTAIN = 2.0, 3.0
"""The gain, and the shift of a corner, must exceed this many of their standard deviations. That of the gain is taken
from how much the tiles differ. This is too much: a distortion that is there saves most of its cost near the corners."""
MAX_SIGMA = 0.01
"""From this predicted error of the shift of a corner on, a distortion is not observable."""
HIDDEN = 4.0
"""From this many times MAX_SIGMA on, for the first cameras with a distortion, neither others nor a zoom are looked for:
with better cameras the error falls to .28 of it at most (.0145 to .0041, the most of the tuned scenes)."""
SUSPECTED_GAIN, SUSPECTED_SHIFT = 0.01, 0.01
"""From this gain or shift on, cameras with a distortion are searched anew, from undistorted matches."""
TRIED = 0.05
"""Shift of a corner, inwards or outwards, from which cameras are searched anew."""
START_FOCAL = 1.05
"""Focal length of the search in longer sides of the image; another one is found by the adjustment."""
LONG_FOCAL = 2.0
"""Beyond this focal length, in longer sides of the image, no distortion is taken without being asked for. Cameras that
follow movers seem to have a lens several times too long, and what bends their paths looks like a distortion."""
ZOOM_GAIN = 0.04
"""From this gain of a focal length per frame on, the lens is judged among cameras that zoom."""
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
        assumed: whether it is taken without a test, if it can be estimated; cameras with one are then searched even
            where the first ones tell nothing about it.
    """
    began = time.process_time()
    shared = shared_matches(graph.source, graph.target, graph.weights, graph.T)
    if np.median(np.diagonal(shared, 1)) < MIN_MATCHES:
        return Lens(None, Evidence("not observable", "neighbouring frames share too few confident matches"))
    factor = thinning(graph, COARSE_PIXELS)
    coarse = thin_graph(graph, factor)
    statistics = classify.measure(coarse, None, seed)
    if statistics.camera == "near-still":
        seconds = time.process_time() - began
        return Lens(None, Evidence("not observable", "the camera hardly moves", seconds=seconds))
    observed = Observed(coarse, coarse, None, [START_FOCAL * coarse.long_side_px], statistics, prior, seed)
    evidence, best, straight = _weigh(observed, len(coarse.pixels) / len(graph.pixels), assumed)
    if assumed and evidence.decision != "not observable":
        evidence = replace(evidence, decision="distorted", reason=f"as the options say; {evidence.reason}")
    elif evidence.decision == "distorted":
        evidence = _unless_long(evidence, best.state.focal_px / graph.long_side_px)
    coefficients = None
    if evidence.decision == "distorted":
        two = replace(straight, lens=2)
        parts = held_out.halves(coarse)
        richer = held_out.fit(parts, best.state, two, prior, "lens, two coefficients")
        saved, sigma = held_out.gain(coarse, (best, richer))
        free = two if saved >= max(MIN_GAIN, SIGNIFICANT * sigma) else replace(two, lens=1)
        coefficients = _refine(graph, richer.state if free is two else best.state, free, prior).lens
    return Lens(coefficients, replace(evidence, seconds=time.process_time() - began))


def _unless_long(evidence: Evidence, sides: float) -> Evidence:
    """Evidence for a distortion, unless its cameras have a focal length, in longer sides, beyond LONG_FOCAL."""
    if sides <= LONG_FOCAL:
        return evidence
    reason = f"{evidence.reason}, but the focal length is {sides:.1f} longer sides, as cameras have that follow movers"
    return replace(evidence, decision="not observable", reason=reason)


def undistorted_graph(graph: FlowGraph, lens: np.ndarray) -> FlowGraph:
    """The graph with pixels and matches freed of a distortion [2] as in `state.State`; they lie on the grid no more."""
    pixels, matches = (undistorted(graph, lens, points) for points in (graph.pixels, graph.matches))
    return replace(graph, pixels=pixels, matches=matches.astype(np.float32), border_px=0.0)


@dataclass(frozen=True)
class _Rivals:
    """The best cameras without and with a distortion, with `unknowns` else, and what the latter save."""

    unknowns: Unknowns
    plain: Fit
    bent: Fit
    gain: float
    gain_sigma: float


def _weigh(observed: Observed, density: float, assumed: bool) -> tuple[Evidence, Fit, Unknowns]:
    """Evidence for a distortion, the best cameras with one, fitted to half of the tiles, and their other unknowns.

    Beside a zoom, cameras at one focal length tell nothing about the lens: it hides in what they leave, or stands in
    for the zoom. Where a zoom is found beside a lens, the lens is therefore judged among cameras that zoom.
    """
    graph = observed.graph
    straight = Unknowns(focal=True, translation=observed.statistics.camera != "rotating")
    rivals = _compare(observed, straight, _fit(observed, _start(observed), straight), density, assumed)
    found = _evidence(graph, rivals, density)
    assert found.shift_sigma is not None
    if straight.translation and (assumed or found.shift_sigma <= HIDDEN * MAX_SIGMA):
        zooming = replace(straight, zoom=True)
        plain = _fit(observed, rivals.plain.state, zooming)
        if found.decision == "distorted" or held_out.gain(graph, (rivals.plain, plain))[0] > zoom.SUSPECTED_GAIN:
            # Of two coefficients: a focal length per frame also explains some of what the second one does.
            fits = [_fit(observed, rivals.bent.state, replace(of, lens=2)) for of in (straight, zooming)]
            gain, sigma = held_out.gain(graph, (fits[0], fits[1]))
            if gain >= max(ZOOM_GAIN, zoom.SIGNIFICANT * sigma):
                rivals = _among_zooms(observed, zooming, plain, density, assumed)
                found = _evidence(graph, rivals, density)
                found = replace(found, reason=f"beside a focal length that changes {found.reason}")
            elif found.decision == "distorted":
                bent = _fit(observed, rivals.bent.state, replace(zooming, lens=1))
                if held_out.gain(graph, (plain, bent))[0] < MIN_GAIN:
                    reason = f"{found.reason}; a focal length that changes explains as much"
                    found = replace(found, decision="straight", reason=reason)
    return found, rivals.bent, rivals.unknowns


def _evidence(graph: FlowGraph, rivals: _Rivals, density: float) -> Evidence:
    shift = _shift(rivals.bent)
    shift_sigma = _shift_sigma(graph, rivals.bent.state, replace(rivals.unknowns, lens=1), density)
    decision, reason = judge(rivals.gain, rivals.gain_sigma, shift, shift_sigma)
    return Evidence(decision, reason, rivals.gain, rivals.gain_sigma, MIN_GAIN, shift=shift, shift_sigma=shift_sigma)


def _fit(observed: Observed, state: State, unknowns: Unknowns, swapped: bool = False) -> Fit:
    parts = held_out.halves(observed.graph)
    return held_out.fit(parts[::-1] if swapped else parts, state, unknowns, observed.prior, "lens")


def _compare(observed: Observed, straight: Unknowns, plain: Fit, density: float, assumed: bool) -> _Rivals:
    """Cameras with a distortion beside `plain`, those without one; both searched anew where there is a suspicion."""
    graph, bent = observed.graph, replace(straight, lens=1)
    best = _fit(observed, replace(plain.state, lens=np.zeros(2)), bent)
    gain, gain_sigma = held_out.gain(graph, (plain, best))
    suspected = gain > SUSPECTED_GAIN or abs(_shift(best)) > SUSPECTED_SHIFT
    if suspected and (assumed or _shift_sigma(graph, best.state, bent, density) <= HIDDEN * MAX_SIGMA):
        searched = _fit(observed, _search(observed, np.copysign(TRIED, _shift(best))), bent)
        best = min((best, searched), key=lambda fit: fit.cost)
        plain = min((plain, _fit(observed, replace(best.state, lens=None), straight)), key=lambda fit: fit.cost)
        swapped = _fit(observed, plain.state, straight, True), _fit(observed, best.state, bent, True)
        gain, gain_sigma = held_out.gain(graph, (plain, best), swapped)
    return _Rivals(straight, plain, best, gain, gain_sigma)


def _among_zooms(observed: Observed, zooming: Unknowns, plain: Fit, density: float, assumed: bool) -> _Rivals:
    """The same among cameras with a focal length per frame, whose change is first seen in pairs of frames."""
    graph, focal_px = observed.graph, plain.state.focal_px
    threshold_px = min(observed.threshold_px / 2, MAX_PAIR_PX)
    curves = [
        zoom.curve_of_pairs(graph, focal_px, step, threshold_px, observed.seed)
        for step in sorted({1, classify.longest_step(graph)})
    ]
    tried = [replace(observed, focals_px=[focal_px], curve=curve) for curve in curves]
    fits = [plain, *(_fit(observed, _start(of), zooming) for of in tried)]
    best = int(np.argmin([fit.cost for fit in fits]))
    return _compare(tried[max(best - 1, 0)], zooming, fits[best], density, assumed)


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
        cameras = state.cam_from_world, state.focal_px
        state = initialise.initial_state(graph, *cameras, FINE_PX[0], zoom=state.zoom, lens=state.lens)
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


def _shift_sigma(graph: FlowGraph, state: State, unknowns: Unknowns, density: float) -> float:
    covariance = solution_covariance(graph, state, unknowns)
    size = 7 * graph.T if unknowns.zoom else 6 * graph.T + 1
    return float(np.sqrt(density * covariance.of(np.append(np.zeros(size), [1.0, 1.0])[None])[0, 0]))
