"""Photometric test of a static world where flow is unreliable.

Failed flow fits no depth, and neither does the flow of a mover: fog, blur and repeated texture look like motion. The
images tell them apart. Warped with a static depth (the pixel's own or that of its neighbours) they match as well as
warped with the flow, unless the pixel moved. Where the light changes they match the flow better; there the texture
tells (`shadows`), and the colour of the change (`shading`). Thin things near the camera match at a depth of their own,
which neither flow nor neighbours have (`swept`).
"""

import itertools

import cv2
import numpy as np

from stages.motion.depth_sweep import Other, hardly_moves
from stages.motion.epipolar import Evidence
from stages.motion.pooling import PRIOR_WEIGHT
from stages.motion.shading import View, changes, in_shadow, log_colours, shadows_of_clip
from stages.motion.shadows import at_rest, log_detail
from stages.motion.swept import FRAMES, explained, run_one_way
from stages.motion.transients import Others
from stages.shared import flow_pairs
from stages.shared.flow_pairs import FlowPairs
from stages.shared.picture_difference import EVERY_PX, difference, exposed, tolerance
from stages.shared.planes import surrounding_plane
from stages.shared.static_flow import dense_static_flow
from stages.shared.threads import threaded
from stages.shared.warp import look_up

RELIABLE = 0.5
"""From this mean confidence over its edges on, the flow of a pixel needs no confirmation, except where, before a camera
that moves, the edges around it run one way."""
REACH = 5
"""Largest distance in frames between compared images: slow motion shows over several frames only."""
FLOW_SHARE = 0.75
"""Share of the flow's photometric residual subtracted from the static one: noise and blur affect both."""
EXCESS = 0.5
"""Excess residual, in units of the tolerance, at which the contradiction is one half."""
EXPLAINED = 0.35
"""Residual below which the depth of a pixel is a candidate for its neighbours."""
STATIC_POWER = 4
"""The larger, the less the depth of a pixel with a residual counts for the plane around it."""
WINDOW_PX, NEIGHBOURS_PX = 5, 15
SURROUNDINGS = 0.19
"""Width of the square whose plane is taken, as a share of the longer side of the frame."""
SUSPECT = 0.25
"""Evidence from which on a static depth is searched for by the pictures."""
NEVER = np.float32(1e30)
"""Beyond every inverse depth."""


def corroborate(
    evidence: Evidence,
    rgb: np.ndarray,
    pairs: FlowPairs,
    projections: tuple[np.ndarray, np.ndarray],
    inverse_depth: np.ndarray,
    drifting: np.ndarray | None = None,
) -> tuple[Evidence, np.ndarray]:
    """Evidence whose residual is reduced where flow is unreliable and the images do not confirm motion, and how surely
    [T, h, w] a frame shows what passes before a scene that the others agree on (`transients`).

    The residual is also reduced where the images show a surface at rest under light that changes.
    Where flow has no weight, the images give it one: the share of confident matches of the frame, at least
    PRIOR_WEIGHT. Without this minimum no motion would show in frames whose flow is bad everywhere.

    Args:
        evidence: residual [T, h, w] of the flow to a static world, and its weight.
        rgb: [T, h, w, 3] uint8 frames on the flow grid.
        projections: A and b of `resweep`, or of every row (`rolling`); inverse_depth: [T, h, w] in the units of b.
        drifting: [T, h, w] of `drift` and `hiding`, which pictures have confirmed; a residual below it is raised to it.
    """

    def view(i: int) -> View:
        return _view(i, evidence, pairs, projections, inverse_depth[i])

    shadows = shadows_of_clip(rgb, evidence.residual, view)

    def of_frame(
        i: int, frames: dict[int, np.ndarray], details: dict[int, np.ndarray], colours: dict[int, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residual and weight [h, w] of frame i, and how surely [h, w] it shows what passes."""
        edges = _edges(pairs, i, flow_pairs.REACH)
        confidence = pairs.confidence[edges].astype(np.float32)
        reliability = confidence.sum(axis=0) / (RELIABLE * max(len(edges), 1))
        depths = static_depths(inverse_depth[i].astype(np.float32), evidence.residual[i])
        static, flows = view(i), pairs.flow[_edges(pairs, i, REACH)]
        ways = static.targets, flows, (static.A, static.b)
        one_way = _untold(frames[i], static.targets - i, static.b, depths[0][evidence.residual[i] < EXPLAINED])
        sure = np.where(one_way, 0, np.minimum(reliability, 1))
        contradicted, odd = _contradicted(frames, i, *ways, depths, evidence.residual[i], sure < 1, one_way)
        residual = evidence.residual[i] * np.maximum(sure, contradicted)
        if drifting is not None:
            residual = np.maximum(residual, drifting[i])
        moved = 1 - at_rest(details, i, rgb[i], *ways, static.inverse_depth)
        if shadows:
            moved *= 1 - in_shadow(changes(colours, i, static), shadows)
        weight = max((confidence > 0.5).mean(), PRIOR_WEIGHT) if len(edges) else 0
        odd *= moved * (1 - np.minimum(reliability, 1))  # it is for what the flow loses
        return residual * moved, np.maximum(evidence.weight[i], weight), odd

    residual, weight = (np.empty(evidence.residual.shape, np.float32) for _ in range(2))
    passing = np.empty(residual.shape, np.float16)
    for first, last in pairs.blocks(len(rgb), "check by the pictures"):
        near = range(max(first - REACH, 0), min(last + REACH, len(rgb)))
        frames = {k: cv2.GaussianBlur(rgb[k], (0, 0), 0.7) for k in near}
        details = {k: log_detail(rgb[k]) for k in near}
        colours = {k: log_colours(rgb[k]) for k in near} if shadows else {}
        shared = (itertools.repeat(of) for of in (frames, details, colours))
        for k, found in enumerate(threaded(of_frame, range(first, last), *shared), first):
            residual[k], weight[k], passing[k] = found
    return Evidence(residual, weight), passing


def _edges(pairs: FlowPairs, i: int, reach: int) -> np.ndarray:
    """Indices of the edges that leave frame i to frames at most `reach` away."""
    edges = np.array(pairs.leaving(i, i + 1), int)
    return edges[np.abs(i - pairs.target[edges]) <= reach]


def _view(
    i: int, evidence: Evidence, pairs: FlowPairs, projections: tuple[np.ndarray, np.ndarray], inverse_depth: np.ndarray
) -> View:
    """Frame i in those at most REACH away, at the depth [h, w] of the planes around its pixels.

    Depth found from flow is wrong where the flow is: in a shadow that moves.
    """
    near = _edges(pairs, i, REACH)
    trust = (1 - evidence.residual[i]) ** STATIC_POWER * evidence.weight[i]
    plane, _ = surrounding_plane(inverse_depth, trust, SURROUNDINGS)
    return View(pairs.target[near], projections[0][near], projections[1][near], plane)


def _untold(frame: np.ndarray, steps: np.ndarray, b: np.ndarray, scene: np.ndarray) -> np.ndarray:
    """Where [h, w] edges of a frame [h, w, 3] run one way before a camera that passes a scene of inverse depths [n].

    Before one that does not, flow that is carried along a rail from what is around it is right.
    """
    if hardly_moves(steps, b, scene, frame.shape[:2]):
        return np.zeros(frame.shape[:2], bool)
    return run_one_way(frame)


def static_depths(inverse_depth: np.ndarray, residual: np.ndarray) -> list[np.ndarray]:
    """Candidate inverse depths [h, w] of a static pixel: the smoothed estimate, the farthest and nearest around it.

    The flow of a thin or moving object leaks onto static pixels beside it, and so does the depth estimated from it.
    """
    smooth = cv2.medianBlur(inverse_depth, WINDOW_PX)
    sure = cv2.blur(residual, (WINDOW_PX, WINDOW_PX)) < EXPLAINED
    kernel = np.ones((NEIGHBOURS_PX, NEIGHBOURS_PX), np.uint8)
    farthest = cv2.erode(np.where(sure, smooth, NEVER), kernel)
    nearest = cv2.dilate(np.where(sure, smooth, -NEVER), kernel)
    around = [np.where(np.abs(depth) < NEVER, depth, smooth) for depth in (farthest, nearest)]
    return [smooth, *around]


def _contradicted(
    frames: dict[int, np.ndarray],
    i: int,
    targets: np.ndarray,
    flows: np.ndarray,
    projections: tuple[np.ndarray, np.ndarray],
    depths: list[np.ndarray],
    residual: np.ndarray,
    unsure: np.ndarray,
    one_way: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """By how much [h, w], 0..1, the flow matches the images better than any static depth, and `Others.odd`; 0 where
    nothing is in view, and where a depth that is searched for explains what would move.

    Earlier and later frames are averaged separately and the better side counts: a pixel occluded on one side is
    usually visible on the other.

    Args:
        residual: [h, w] of the flow to a static world; unsure: [h, w], where the flow needs confirmation.
        one_way: [h, w], where edges run one way.
    """
    here = frames[i]
    total, seen = np.zeros((2, 2, 1 + len(depths), *here.shape[:2]), np.float32)
    others, compared = Others(len(depths), here), []
    for j, flow, A, b in zip(targets, flows, *projections, strict=True):
        ways = [flow.astype(np.float32, copy=False), *(dense_static_flow(A, b, depth) for depth in depths)]
        shown = [look_up(frames[int(j)], way) for way in ways]
        expected = exposed(here, shown[0][0][::EVERY_PX, ::EVERY_PX])
        for k, (found, inside) in enumerate(shown):
            apart = inside * difference(found, expected, WINDOW_PX)
            total[int(j > i), k] += apart
            seen[int(j > i), k] += inside
            if k == 0 and abs(j - i) <= FRAMES:
                compared.append(Other(int(j - i), frames[int(j)], expected, apart, inside, A, b))
            if k > 0:
                others.add(j > i, k - 1, found, expected, inside)
    mean = np.where(seen > 0, total / np.maximum(seen, 1), np.inf).min(axis=0)
    in_view = np.isfinite(mean[0]) & np.isfinite(mean[1:]).any(axis=0)
    excess = np.where(in_view, mean[1:].min(axis=0), 0) - FLOW_SHARE * np.where(in_view, mean[0], 0)
    allowed = tolerance(here)
    squared = (np.maximum(excess, 0) / (EXCESS * allowed)) ** 2
    contradicted, odd = squared / (1 + squared), others.odd(np.where(in_view, mean.min(axis=0), 0), allowed)
    suspect = unsure & ((residual * contradicted > SUSPECT) | (odd > SUSPECT))
    at_some_depth = explained(compared, suspect, depths[0][residual < EXPLAINED], one_way)
    return np.where(at_some_depth, 0, contradicted), np.where(at_some_depth, 0, odd)
