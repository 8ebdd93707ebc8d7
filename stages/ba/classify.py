"""Named statistics that tell, without truth, what kind of camera motion this is."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import minimize_scalar

from stages.ba import twoview
from stages.ba.graph import MIN_MATCHES, MIN_WEIGHT, FlowGraph
from stages.ba.rotation import FOCALS

NOISE_RATIO = 2.47
"""What noise alone leaves of a rotation over what it leaves of epipolar geometry, both medians of lengths.

A rotation fits neither component of the noise, of deviation s: the median length of both is s sqrt(2 ln 2) = 1.177 s.
Depth takes up the component along the epipolar line; of the other, shared between both ends of the match, the Sampson
distance is s / sqrt(2), its median 0.477 s. (Measured on pans of 8 to 58 px a frame: 2.5 to 3.3; blurred ones to 4.2.)
"""
TWO_VIEW_PX = 0.5
"""Scale of the inliers of a two-view fit."""
FOCAL_TOLERANCE = 0.003
"""Of the logarithm of the focal length that explains a rotation best."""
STILL_PX = 1.0
"""A camera whose rotation-like flow is below this per frame stands nearly still."""
FLOOR_PX = 0.05
"""Two-view residuals below this say nothing more about which model fits."""
MOST = 80
"""Percentile of the residuals that stands for most matches: movers and outliers may be beyond."""
RESIDUAL_RATIO = 3.0
"""Residuals that many times larger than others are of another kind."""
PAIRS = 8
BASELINE = 5
"""Frames of the long baseline, unless told otherwise."""
MATCHED = 0.5
"""Distant frames are related as long as they share this part of the matches that neighbours share."""


@dataclass(frozen=True)
class Statistics:
    """Medians over pairs of frames, in px of the flow grid, of confident static matches.

    Attributes:
        offset: frame distance of the long baseline.
        flow_px: length of the flow between neighbours.
        rotation_1_px, rotation_px: what a rotation leaves unexplained, between neighbours and over the long baseline,
            at the focal length that explains all pairs best.
        sampson_1_px, sampson_px: the same for epipolar geometry.
        homography_px: for a homography, over the long baseline.
        most_sampson_px, most_homography_px: what these leave of four matches in five, at most.
    """

    offset: int
    flow_px: float
    rotation_1_px: float
    rotation_px: float
    sampson_1_px: float
    sampson_px: float
    homography_px: float
    most_sampson_px: float
    most_homography_px: float

    @property
    def camera(self) -> str:
        """Class of the camera motion: "moving", "rotating" or "near-still".

        It is moving if what a rotation leaves is of another kind than the noise of the flow. The noise is what epipolar
        geometry leaves of the same matches, and so grows with the length of the flow as theirs does. Neighbours decide
        as well as the long baseline: what a fast camera passes is matched between neighbours alone, and over several
        frames only the distance is left, which turns.
        """
        pairs = (self.rotation_1_px, self.sampson_1_px), (self.rotation_px, self.sampson_px)
        if any(turned >= RESIDUAL_RATIO * NOISE_RATIO * max(noise, FLOOR_PX) for turned, noise in pairs):
            return "moving"
        return "rotating" if self.flow_px > STILL_PX else "near-still"

    @property
    def dominant_plane(self) -> bool:
        """Whether one plane explains half of what a moving camera sees: it may then draw two-view fits to itself."""
        return self.camera == "moving" and self.homography_px < RESIDUAL_RATIO * max(self.sampson_px, FLOOR_PX)

    @property
    def planar(self) -> bool:
        """Whether one plane explains most of what a moving camera sees."""
        limit = RESIDUAL_RATIO * max(self.most_sampson_px, FLOOR_PX)
        return self.camera == "moving" and self.most_homography_px < limit


def longest_step(graph: FlowGraph) -> int:
    """The largest distance of frames that are still matched well."""
    length, confident = np.abs(graph.target - graph.source), (graph.weights > MIN_WEIGHT).sum(axis=1)
    usual = {step: float(np.median(confident[length == step])) for step in np.unique(length).tolist()}
    return max(step for step, count in usual.items() if count >= MATCHED * usual[min(usual)])


def measure(graph: FlowGraph, focal_px: float | None, seed: int, baseline: int = BASELINE) -> Statistics:
    """Statistics of the matches at a known focal length, or else at the one that lets a rotation explain them best.

    A pan seen at a focal length a few per cent off leaves pixels, not noise: no list of focal lengths will do.
    """
    offset = max(int(step) for step in np.unique(graph.target - graph.source) if step <= baseline)
    near, far = _pairs(graph, 1), _pairs(graph, offset)
    flow = [np.median(np.linalg.norm(x - y, axis=1)) for x, y, _ in (_rays(graph, pair, 1.0) for pair in near)]
    best = focal_px or _rotation_focal(graph, far)
    sampson = [_sampson(graph, pair, best, seed) for pair in far]
    homography = [_homography(graph, pair) for pair in far]
    return Statistics(
        offset,
        _median(flow),
        _median([_rotation(graph, pair, best) for pair in near]),
        _median([_rotation(graph, pair, best) for pair in far]),
        _median([np.median(_sampson(graph, pair, best, seed)) for pair in near]),
        _median([np.median(residuals) for residuals in sampson]),
        _median([np.median(residuals) for residuals in homography]),
        _median([np.percentile(residuals, MOST, method="lower") for residuals in sampson]),
        _median([np.percentile(residuals, MOST, method="lower") for residuals in homography]),
    )


def _pairs(graph: FlowGraph, offset: int) -> list[tuple[int, int]]:
    """At most PAIRS pairs of frames at this distance that have enough matches, spread over the sequence."""
    pairs = [(i, i + offset) for i in range(graph.T - offset)]
    usable = [pair for pair in pairs if len(_rays(graph, pair, 1.0)[0]) >= MIN_MATCHES]
    return [usable[k] for k in np.unique(np.linspace(0, len(usable) - 1, PAIRS).astype(int))] if usable else []


def _rays(graph: FlowGraph, pair: tuple[int, int], focal_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return twoview.pair_rays(graph, *pair, focal_px)


def _rotation_focal(graph: FlowGraph, pairs: list[tuple[int, int]]) -> float:
    """The focal length in px at which rotations leave least of the matches of these pairs, within those of a camera."""

    def left(log_focal: float) -> float:
        return _median([_rotation(graph, pair, float(np.exp(log_focal))) for pair in pairs])

    logs = np.log(FOCALS * graph.width)
    best = int(np.argmin([left(log_focal) for log_focal in logs]))
    if not pairs:
        return float(np.exp(logs[best]))
    bounds = logs[max(best - 1, 0)], logs[min(best + 1, len(logs) - 1)]
    found = minimize_scalar(left, bounds=bounds, method="bounded", options={"xatol": FOCAL_TOLERANCE})
    return float(np.exp(found.x))


def _rotation(graph: FlowGraph, pair: tuple[int, int], focal_px: float) -> float:
    return float(np.median(twoview.fit_rotation(*_rays(graph, pair, focal_px), focal_px)[1]))


def _sampson(graph: FlowGraph, pair: tuple[int, int], focal_px: float, seed: int) -> np.ndarray:
    """Residuals [n] in px from the epipolar geometry; infinite without any."""
    x, y, w = _rays(graph, pair, focal_px)
    fit = twoview.estimate_motion(x, y, w, focal_px, TWO_VIEW_PX, seed)
    if fit is None:
        return np.full(1, np.inf)
    return np.asarray(np.abs(twoview.sampson_errors(fit.R, fit.t, x, y)) * focal_px)


def _homography(graph: FlowGraph, pair: tuple[int, int]) -> np.ndarray:
    """Residuals [n] in px from a homography; infinite without any."""
    x, y, _ = _rays(graph, pair, 1.0)
    H, _ = cv2.findHomography(x, y, cv2.RANSAC, 1.0)
    if H is None:
        return np.full(1, np.inf)
    return np.asarray(np.linalg.norm(cv2.perspectiveTransform(x[None], H)[0] - y, axis=1))


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if len(values) else float("inf")
