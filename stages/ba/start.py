"""Initialisation: camera paths from the matches alone, and the choice between camera motion and object motion.

Initial guesses are adjusted and compared on a coarse grid of pixels; the best one is refined on the full grid.
"""

from dataclasses import dataclass, replace

import numpy as np

from stages.ba import dba, initialise, two_motions, zoom
from stages.ba.border_focals import border_path
from stages.ba.classify import longest_step
from stages.ba.diagnostics import ROUGH_PATH, of_zoom
from stages.ba.graph import MIN_WEIGHT, FlowGraph, thin_graph, thinning, without_loops
from stages.ba.guesses import ENOUGH, MAX_PAIR_PX, Observed, guess
from stages.ba.initialise import Candidate
from stages.ba.other_focals import better_focal
from stages.ba.part import FRAMES
from stages.ba.refinement import UNUSUAL_FOCAL
from stages.ba.state import Level, State, Unknowns
from stages.ba.weights import mask_graph
from stages.ba.zoom import Evidence

COARSE_PIXELS = 400
"""Guesses are compared on a grid of about this many pixels per frame."""
SMOOTHER = 0.5
"""Masks are wrong if, without them, a path of less than this share of the roughness fits the matches as well."""
FITTING_PX = (0.3, 1.0)
"""Limits of the scale, in px, up to which a match fits."""
EXPLAINED = 0.85
"""If less than this share of the pixels fits the motion found, the others may be the background."""
SAME_PIXELS = 0.5
"""A motion that also fits this share of the pixels of the first one is the same motion."""


@dataclass(frozen=True)
class Start:
    """The chosen initialisation.

    Attributes:
        candidate: adjusted on the coarse grid; others: the candidates it was compared with.
        graph: observations to refine it on.
        static: [T, height, width] 0 or 1, the static area used instead of the input masks; None: the masks were kept.
        flags: warnings about the choice.
        zoom: the decision about a changing focal length, if there was one.
        focal_px: that of a `border_path`, to which the prior of the focal length is moved.
    """

    candidate: Candidate
    others: list[Candidate]
    graph: FlowGraph
    static: np.ndarray | None
    flags: list[str]
    zoom: Evidence | None = None
    focal_px: float | None = None


def find_start(observed: Observed) -> Start:
    """Adjust guesses, also without masks if the path is rough, and look for a second motion in unexplained pixels."""
    factor = thinning(observed.graph, COARSE_PIXELS)
    plain, coarse = (thin_graph(without_loops(graph), factor) for graph in (observed.unmasked, observed.graph))
    candidates = guess(observed, coarse)
    if observed.free and not (observed.previous and observed.previous.alone):
        focal_px = better_focal(observed, coarse, initialise.choose(candidates))
        if focal_px:
            candidates = guess(replace(observed, previous=None, focals_px=[focal_px]), coarse)
    evidence = None
    if observed.tested:
        evidence, changing = _with_zoom(observed, coarse, initialise.choose(candidates))
        if changing:
            observed = replace(observed, curve=changing.state.zoom)
            candidates = [changing]
    apart = None
    if evidence is None or not of_zoom(evidence):  # a zoom that may be there explains what the cameras do not fit
        apart = _apart(observed, plain, coarse, initialise.choose(candidates))
    return apart or replace(_check(observed, plain, candidates), zoom=evidence)


def _apart(observed: Observed, plain: FlowGraph, coarse: FlowGraph, best: Candidate) -> Start | None:
    """The background's motion where the best candidate mixes it with that of a mover, told in short first rounds alone.

    Later rounds begin there, with masks made from its cameras.
    """
    if not observed.free or observed.previous or plain.T > FRAMES:
        return None
    used = plain if observed.unmasked is observed.graph else coarse
    motion = two_motions.background(plain, used, best.state, observed.prior)
    bordered = None if motion else border_path(observed, plain, used, best)
    motion = motion or bordered
    if motion is None:
        return None
    static = _areas(plain, motion.fits)
    masked = mask_graph(plain, static)
    candidate = initialise.adjust(
        masked, motion.state, two_motions.NARROW, Unknowns(focal=bordered is None), observed.prior, "apart"
    )
    reason = "two motions: a mover was left out of the first cameras"
    start = _start_on(observed, candidate, [], static, reason)
    if bordered:  # what the background alone tells of the focal length may be little
        start = replace(start, focal_px=bordered.state.focal_px)
    if not observed.tested:
        return start
    prior = replace(observed.prior, focal_px=start.focal_px or observed.prior.focal_px)
    without = replace(observed, graph=start.graph, curve=None, masked=True, prior=prior)
    evidence, changing = _with_zoom(without, masked, candidate)
    return replace(start, candidate=changing or candidate, zoom=evidence)


def _with_zoom(observed: Observed, coarse: FlowGraph, best: Candidate) -> tuple[Evidence, Candidate | None]:
    """The decision about a changing focal length, and the candidate with one if it changes."""
    previous, focal_px = observed.previous, best.state.focal_px

    def search() -> list[State]:
        threshold_px = min(observed.threshold_px / 2, MAX_PAIR_PX)
        steps = sorted({1, longest_step(coarse)})
        # One focal length makes up for a zoom by a lens several times too long, from which no search leads back.
        usual_px = observed.prior.focal_px
        unusual = max(focal_px / usual_px, usual_px / focal_px) > UNUSUAL_FOCAL
        tried = [
            (at_px, zoom.curve_of_pairs(coarse, at_px, step, threshold_px, observed.seed))
            for at_px in ([focal_px, usual_px] if unusual else [focal_px])
            for step in steps
        ]
        tried += [(focal_px, previous.zoom)] if previous and previous.zoom is not None else []
        rivals = [replace(observed, focals_px=[at_px], curve=curve) for at_px, curve in tried]
        return [initialise.choose(guess(rival, coarse)).state for rival in rivals]

    density = len(coarse.pixels) / len(observed.graph.pixels)
    evidence, state = zoom.weigh(coarse, best.state, search, observed.prior, density, observed.assumed)
    if observed.assumed:
        evidence = replace(evidence, decision="changing", reason=f"as the options say; {evidence.reason}")
    if evidence.decision != "changing":
        return evidence, None
    levels = (Level(observed.threshold_px, 8, ENOUGH),)
    return evidence, initialise.adjust(coarse, state, levels, zoom.PER_FRAME, observed.prior, "zoom")


def _check(observed: Observed, plain: FlowGraph, candidates: list[Candidate]) -> Start:
    """The best candidate, or one without masks or of a second motion if they explain more."""
    best, ignored = initialise.choose(candidates), ""
    if observed.unmasked is not observed.graph and best.roughness > ROUGH_PATH:
        unmasked = guess(replace(observed, focals_px=[best.state.focal_px]), plain)
        rival = initialise.choose(unmasked)
        if _costs_no_more(plain, rival, best, observed.threshold_px) and rival.roughness < SMOOTHER * best.roughness:
            ignored = f"masks ignored: without them the path is {best.roughness / rival.roughness:.0f} times as smooth"
            best, candidates = rival, unmasked
    fits = explained(plain, best.state)
    if two_motions.share(fits, two_motions.matched_pixels(plain)) < EXPLAINED:
        second = _second_motion(replace(observed, focals_px=[best.state.focal_px], previous=None), plain, fits)
        if second:
            return second
    others = [other for other in candidates if other is not best]
    if not ignored:
        return Start(best, others, observed.graph, None, [])
    return _start_on(observed, best, others, _areas(plain, fits), ignored)


def explained(graph: FlowGraph, state: State) -> np.ndarray:
    """Which pixels [T, P] fit the poses of `state` at some depth: half of their matches, within 3 median errors.

    So do those without matches, as of blurred movers: shares are to be taken among matched pixels.
    """
    state = initialise.initial_state(graph, state.cam_from_world, state.focal_px, FITTING_PX[1], state.zoom)
    errors = dba.errors_px(graph, state)
    sigma_px = np.clip(3 * np.median(errors[graph.weights > MIN_WEIGHT]), *FITTING_PX)
    return dba.fitting_pixels(graph, errors, float(sigma_px), 0.5)


def _costs_no_more(plain: FlowGraph, rival: Candidate, best: Candidate, sigma_px: float) -> bool:
    """Whether the rival costs no more than the best over all matches, up to COST_MARGIN."""

    def cost(state: State) -> float:
        searched = initialise.initial_state(plain, state.cam_from_world, state.focal_px, sigma_px, state.zoom)
        return dba.robust_cost(plain, dba.errors_px(plain, searched), sigma_px)

    return cost(rival.state) <= (1 + initialise.COST_MARGIN) * cost(best.state)


def _second_motion(observed: Observed, plain: FlowGraph, fits: np.ndarray) -> Start | None:
    """The motion of the pixels that the first motion does not explain, if it is the background's.

    Two rigid motions explain their own pixels equally well. The background is the motion that covers more of the image
    border, since objects stand in front of it.
    """
    unexplained = mask_graph(plain, _areas(plain, ~fits))
    candidates = guess(observed, unexplained)
    rival = initialise.choose(candidates)
    own, matched = explained(plain, rival.state), two_motions.matched_pixels(plain)
    along = matched & two_motions.border(plain)
    shares = two_motions.share(fits, along), two_motions.share(own, along)
    same = two_motions.share(own, fits & matched) > SAME_PIXELS
    if same or shares[1] <= shares[0]:
        return None
    reason = f"two motions: the one taken follows {shares[1]:.2f} of the image border, the other {shares[0]:.2f}"
    others = [other for other in candidates if other is not rival]
    return _start_on(observed, rival, others, _areas(plain, own), reason)


def _start_on(observed: Observed, best: Candidate, others: list[Candidate], static: np.ndarray, reason: str) -> Start:
    """A start whose refinement uses the static area found here instead of the input masks."""
    return Start(best, others, mask_graph(observed.unmasked, static), static, [reason])


def _areas(graph: FlowGraph, chosen: np.ndarray) -> np.ndarray:
    """The pixels `chosen` [T, P] as areas [T, height, width] of the flow grid, isolated pixels removed."""
    maps = two_motions.smooth(graph, chosen).reshape(graph.T, graph.rows, graph.columns)
    return graph.spread(maps.astype(np.uint8)).view(np.int8)
