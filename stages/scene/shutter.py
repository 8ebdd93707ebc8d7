"""Evidence for motion blur, and how long the shutter is open: frames blurred again and compared.

A point that moves by v px per frame is smeared along s v while the shutter is open for s frames. If it is sharp as I,
frames i and j show K_i I and K_j I, where K_i and K_j average along s v_i and s v_j. Each smeared as the other is, they
are equal. That is a = b with

    a = (K_i + K_j) (B_i - B_j) / 2,    b = (K_i - K_j) (B_i + B_j) / 2:

the faster frame lacks what b says. Noise, and errors of the flow, are as likely in one frame as in the other. They
leave the product of a and b zero on average, since b changes its sign with the exchange of both and a too. So
<a, b> / <b, b> is 1 at the true shutter, more at shorter ones and less at longer ones: no prior on sharpness of the
scene is needed, but the same points at different speeds.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np

from stages.scene.blur_rules import is_ruled_out
from stages.scene.geometry import MIN_CONFIDENCE
from stages.scene.observed import Observed
from stages.scene.shutter_fit import SHUTTERS, TILES, judge
from stages.shared.frame_store import Computed, Frames
from stages.shared.images import DISPLAY_GAMMA
from stages.shared.light import BRIGHT
from stages.shared.log import progress
from stages.shared.warp import is_inside, matches, warp

PAIRS, FIRST_PAIRS = 12, 4
"""Number of pairs of frames, those between which the speeds differ most, and how many of them may rule out blur."""
MOST_PAIRS = 1000
"""Of more pairs, those of clips over some 250 frames, so many spread over the clip are compared."""
HELD_FRAMES = 48
"""Frames whose motion is kept for the next edge."""
MAX_STRIDE = 2
"""Frames between the two of an edge from which the speed is taken."""
SMOOTH_PX = 0.7
FOOTPRINT_PX2 = SMOOTH_PX**2 + 1 / 6
"""Variance of what a pixel averages, per axis: SMOOTH_PX, the pixel itself and its reduction to the flow grid."""
FLOW_SMOOTH_PX = 2.0
MAX_MAGNIFICATION = 2.0
"""Points whose area changes by more between two frames are left out."""
STEEPEST_PX = 6.0
"""Differences of speed count up to here in the choice of pairs: beyond, more of them are errors."""
UNLIKE, COARSE_PX = 4.0, 4.0
"""Pixels differ in what they show if their difference, smoothed by COARSE_PX, exceeds UNLIKE times the median one."""
FAST_QUANTILE = 0.95
LEAST_PIXELS = 100


def shutter_evidence(seen: Observed, least_px: float, given: float | None = None) -> dict[str, float]:
    """The shutter, what it predicts on image tiles held out of its fit, and the speeds, in px of the flow grid.

    Args:
        least_px: speed below which nothing is measured. given: the shutter in frames, if it is known.

    Returns:
        speed_px: per frame, exceeded by a twentieth of the pixels of the fastest frame; the others are missing if it is
        below `least_px`. speed_agreement: as `_agreement`. shutter, shutter_sigma: open time in frames, 0..1, and its
        standard error. gain_percent, gain_sigma_percent: share of the squared difference between frames that the blur
        predicts, and its standard error. expected_percent: the gain if the shutter is right; its negative if there is
        no blur. slope_sigma: standard error of the slope at half a frame: 0 is no blur, 1 that of this shutter.
    """
    F = len(seen.dynamic)
    motion = functools.lru_cache(HELD_FRAMES)(functools.partial(_motion, seen))
    speed, edges = _speeds(seen, motion)
    evidence = {"speed_px": speed}
    if evidence["speed_px"] < least_px or not edges:
        return evidence
    evidence["speed_agreement"] = _agreement(seen, motion, edges)
    grey = Computed(F, functools.partial(_grey, seen), HELD_FRAMES)
    first, rest = edges[: 2 * FIRST_PAIRS], edges[2 * FIRST_PAIRS :]
    sums = np.sum([_compare(seen, grey, motion, edge) for edge in first], axis=0)
    found = judge(sums, given)
    speeds_differ = bool(sums[2].any())  # not where too few pixels could be compared
    if rest and not (speeds_differ and is_ruled_out(found)):
        found = judge(sums + np.sum([_compare(seen, grey, motion, edge) for edge in rest], axis=0), given)
    return evidence | found


class _Motion(NamedTuple):
    """How a frame moves in px per frame.

    Attributes:
        sides: [2, h, w, 2] by the nearest frame before and after. weights: [2, h, w] of them.
        velocity: [h, w, 2], their mean. trusted: [h, w] bool, where it is known.
    """

    sides: np.ndarray
    weights: np.ndarray
    velocity: np.ndarray
    trusted: np.ndarray


Motions = Callable[[int], _Motion]
"""That of each frame, by its index."""


def _motion(seen: Observed, k: int) -> _Motion:
    sides = np.zeros((2, *seen.dynamic.shape[1:], 2), np.float32)
    weights = np.zeros(sides.shape[:-1], np.float32)
    for side, ahead in enumerate((-1, 1)):
        near = (seen.edges[:, 0] == k) & (ahead * seen.offsets > 0) & (np.abs(seen.offsets) <= MAX_STRIDE)
        rows = np.flatnonzero(near)
        if len(rows):
            row = rows[np.abs(seen.offsets[rows]).argmin()]
            sides[side] = seen.flow[row] / seen.offsets[row]
            weights[side] = seen.confidence[row]
    total = weights.sum(axis=0)
    velocity = np.asarray((weights[..., None] * sides).sum(axis=0) / np.maximum(total, 1e-6)[..., None])
    return _Motion(sides, weights, velocity, total >= MIN_CONFIDENCE)


def _grey(seen: Observed, k: int) -> np.ndarray:
    """The linear brightness [h, w] of a frame, a little smoothed."""
    return cv2.GaussianBlur((seen.rgb[k] ** DISPLAY_GAMMA).mean(axis=-1), (0, 0), SMOOTH_PX)


def _agreement(seen: Observed, motion: Motions, edges: list[int]) -> float:
    """Correlation of how the squared speeds differ between frames, by the frames before and by those after: 0 if noise.

    Args:
        edges: rows.
    """
    products = np.zeros((2, 2))
    for edge in edges:
        flow, part = seen.flow[edge], (slice(None, None, 4), slice(None, None, 4))
        here, there = (motion(int(k)) for k in seen.edges[edge])
        known, known_there = ((ends.weights >= MIN_CONFIDENCE).all(axis=0) for ends in (here, there))
        good = (seen.confidence[edge] >= MIN_CONFIDENCE) & is_inside(flow) & known
        both_there = np.asarray(known_there, np.float32)
        good &= warp(both_there, flow) == 1
        sides = zip(here.sides, there.sides, strict=True)
        change = [(v**2).sum(axis=-1) - (warp(v_there, flow) ** 2).sum(axis=-1) for v, v_there in sides]
        values = np.stack([np.clip(c, -(STEEPEST_PX**2), STEEPEST_PX**2)[part][good[part]] for c in change])
        products += values @ values.T
    return float(products[0, 1] / max(np.sqrt(products[0, 0] * products[1, 1]), 1e-12))


def _speeds(seen: Observed, motion: Motions) -> tuple[float, list[int]]:
    """The speed of the fastest frame in px, and the rows of the edges between the PAIRS pairs of frames whose speeds
    differ most, both ways.

    Frame by frame, so that the motion of each is read once while all that it is compared with is held.
    """
    row_of = {tuple(edge): row for row, edge in enumerate(seen.edges.tolist())}
    pairs = sorted((j, i) for i, j in row_of if i < j and (j, i) in row_of)
    before: dict[int, list[int]] = {}
    compared = np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), MOST_PAIRS)).astype(int))
    for j, i in (pairs[n] for n in compared):
        before.setdefault(j, []).append(i)
    fastest, contrast = 0.0, {}
    for j in progress(range(len(seen.dynamic)), "speeds"):
        there = motion(j)
        if there.trusted.any():
            speed = np.linalg.norm(there.velocity, axis=-1)[there.trusted]
            fastest = max(fastest, float(np.quantile(speed, FAST_QUANTILE)))
        for i in before.get(j, []):
            contrast[i, j] = _contrast(seen, row_of[i, j], motion(i), there)
    best = sorted(contrast, key=lambda pair: -contrast[pair])[:PAIRS]
    return fastest, [row_of[way] for i, j in best for way in ((i, j), (j, i))]


def _contrast(seen: Observed, row: int, here: _Motion, there: _Motion) -> float:
    """How much the squared speeds differ along an edge: the mean square over its pixels."""
    flow, part = seen.flow[row], (slice(None, None, 4), slice(None, None, 4))
    change = (here.velocity**2).sum(axis=-1) - (warp(there.velocity, flow) ** 2).sum(axis=-1)
    good = (seen.confidence[row] >= MIN_CONFIDENCE) & here.trusted & is_inside(flow)
    return float((np.minimum(np.abs(change), STEEPEST_PX**2) ** 2 * good)[part].mean())


def _compare(seen: Observed, grey: Frames[np.ndarray], motion: Motions, edge: int) -> np.ndarray:
    """Sums [3, SHUTTERS, tiles] of a a, a b and b b over the pixels of an edge, weighted by their precision."""
    (i, j), flow = seen.edges[edge].tolist(), seen.flow[edge]
    (_, _, velocity, trusted), (_, _, velocity_there, trusted_there) = motion(i), motion(j)
    here, there = grey[i], cv2.remap(grey[j], *matches(flow), cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
    back, area = _inverse_jacobian(flow)
    good = (seen.confidence[edge] >= MIN_CONFIDENCE) & is_inside(flow) & trusted
    good &= (warp(trusted_there.astype(np.float32), flow) == 1) & (np.abs(np.log(area)) < np.log(MAX_MAGNIFICATION))
    good &= np.maximum(here, there) < BRIGHT**DISPLAY_GAMMA
    tiles, n = _tiles(*here.shape).ravel(), TILES[0] * TILES[1]
    if good.sum() < LEAST_PIXELS:
        return np.zeros((3, len(SHUTTERS), n))
    there = there * np.median(here[good] / np.maximum(there[good], 1e-3))
    difference, total = here - there - _footprint_change(here + there, back), here + there
    weight = _weights(difference, total, good).ravel()
    there_velocity = np.einsum("hwab,hwb->hwa", back, warp(velocity_there, flow))
    both = np.stack([difference, total], axis=-1)
    sums = []
    for one, other in zip(_smeared(both, velocity), _smeared(both, there_velocity), strict=True):
        a, b = (one + other)[..., 0].ravel() / 2, (one - other)[..., 1].ravel() / 2
        sums.append([np.bincount(tiles, weight * product, n) for product in (a * a, a * b, b * b)])
    return np.swapaxes(np.array(sums), 0, 1)


def _weights(difference: np.ndarray, total: np.ndarray, good: np.ndarray) -> np.ndarray:
    """Precision of pixels [h, w], 0 where not good or unlike; errors of the flow make a difference of the gradient."""
    coarse = np.abs(cv2.GaussianBlur(difference, (0, 0), COARSE_PX))
    alike = good & (coarse < UNLIKE * np.median(coarse[good]))
    by_u, by_v = (cv2.Sobel(total, cv2.CV_32F, *order, scale=1 / 16) for order in ((1, 0), (0, 1)))
    squared = by_u**2 + by_v**2
    weight = alike / np.maximum(squared + np.median(squared[good]), 1e-12)
    noise = (weight * cv2.GaussianBlur(difference, (0, 0), 1.0) ** 2).sum() / max(alike.sum(), 1)
    return np.asarray(weight / max(noise, 1e-12))


def _inverse_jacobian(flow: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse [h, w, 2, 2] of the derivative of the matches by the pixel, and the magnification of areas [h, w]."""
    smooth = cv2.GaussianBlur(flow, (0, 0), FLOW_SMOOTH_PX)
    by_u, by_v = (cv2.Sobel(smooth, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
    (a, b), (c, d) = (1 + by_u[..., 0], by_v[..., 0]), (by_u[..., 1], 1 + by_v[..., 1])
    area = np.maximum(a * d - b * c, 1e-3)
    return np.stack([d, -b, -c, a], axis=-1).reshape(*area.shape, 2, 2) / area[..., None, None], area


def _footprint_change(total: np.ndarray, back: np.ndarray) -> np.ndarray:
    """What B_i lacks against B_j since a pixel of j covers another part of the surface: half their Hessian [h, w].

    Args:
        total: B_i + B_j. back: the inverse Jacobian.
    """
    covariance = FOOTPRINT_PX2 * (np.eye(2) - back @ np.swapaxes(back, -1, -2))
    uu, vv, uv = (cv2.Sobel(total, cv2.CV_32F, *order, scale=1 / 4) for order in ((2, 0), (0, 2), (1, 1)))
    mean = covariance[..., 0, 0] * uu + 2 * covariance[..., 0, 1] * uv + covariance[..., 1, 1] * vv
    return np.asarray(mean / 4, np.float32)


def _smeared(images: np.ndarray, velocity: np.ndarray) -> list[np.ndarray]:
    """Images [h, w, c] averaged along each of SHUTTERS times the velocity [h, w, 2]."""
    total, means = np.zeros_like(images), []
    for k in range(len(SHUTTERS)):
        for side in (-1, 1):
            offset = side * (k + 0.5) * SHUTTERS[0] / 2
            total += cv2.remap(images, *matches(offset * velocity), cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
        means.append(total / (2 * (k + 1)))
    return means


def _tiles(height: int, width: int) -> np.ndarray:
    v, u = np.mgrid[:height, :width]
    return np.asarray((v * TILES[0] // height) * TILES[1] + u * TILES[1] // width)
