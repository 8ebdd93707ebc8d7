"""Statistics that classify the camera motion without ground truth."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import minimize_scalar

from stages.ba import twoview
from stages.ba.graph import MIN_MATCHES, MIN_WEIGHT, FlowGraph
from stages.ba.rotation import FOCALS
from stages.shared.flow_pairs import REACH

NOISE_RATIO = 2.47
"""Ratio of the median residuals of a rotation and of epipolar geometry if the residuals are noise alone.

Noise has standard deviation s per component. A rotation fits neither component: the median length of the residual is
s sqrt(2 ln 2) = 1.177 s. Depth absorbs the component along the epipolar line. The Sampson distance shares the other
between both ends of the match: its standard deviation is s / sqrt(2), the median of its size 0.477 s. (Measured on
pans of 8 to 58 px a frame: 2.5 to 3.3; on blurred ones up to 4.2.)
"""
DOUBT = 1.4
"""From this many times what noise leaves a rotation is doubtful: pans leave up to 1.3 times, blurred ones up to 1.7."""
TWO_VIEW_PX = 0.5
"""Inlier threshold of a two-view fit."""
FOCAL_TOLERANCE = 0.003
"""Tolerance of the logarithm of the focal length that fits a rotation best."""
STILL_PX, TURNS_PX = 1.0, 0.2
"""A camera whose flow fits a rotation and is below the first per frame is called near-still; if a rotation leaves no
more than noise, below the second."""
FLOOR_PX = 0.05
"""Two-view residuals below this do not tell models apart."""
AT_REST, MOVES = 0.1, 0.05
"""Shares of `stages.ba.ground.at_rest` from which on ground rests, and below which it moves, as measured there."""
MOST = 80
"""Percentile of the residuals that represents most matches: movers and outliers may lie above it."""
RESIDUAL_RATIO = 3.0
"""From this ratio of residuals on, the larger one is not explained by noise."""
PAIRS = 8
BASELINE = 5
"""Default frame distance of the long baseline."""
MATCHED = 0.5
"""Distant frames count as well matched if they share this part of the matches that neighbours share."""


@dataclass(frozen=True)
class Statistics:
    """Residuals of confident static matches, in px of the flow grid: medians over pairs of frames.

    Attributes:
        offset: frame distance of the long baseline.
        flow_px: length of the flow between neighbours.
        rotation_1_px, rotation_px: median residual of a rotation, between neighbours and over the long baseline, at the
            focal length that fits all pairs best.
        sampson_1_px, sampson_px: the same of epipolar geometry (Sampson distance).
        homography_px: the same of a homography, over the long baseline.
        most_sampson_px, most_homography_px: their 80th percentiles, over the long baseline.
        turns: whether turns may explain flow below STILL_PX; not where they leave the focal length open.
        parallax: whether a path was found to explain the matches far better than a doubtful rotation.
        ground: what `stages.ba.ground.at_rest` gives; None too where it was not asked for.
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
    turns: bool = True
    parallax: bool = False
    ground: float | None = None

    @property
    def camera(self) -> str:
        """Class of the camera motion: "moving", "rotating" or "near-still".

        It is moving if the residual of a rotation is not explained by the noise of the flow. The noise is the epipolar
        residual of the same matches, so it grows with the length of the flow as the rotation residual does. Both the
        neighbours and the long baseline can decide: near points that a fast camera passes are matched between
        neighbours alone; over several frames only far points are matched, whose flow is nearly a rotation. It is moving
        too if a path is known to explain the matches far better. As long as none is, it is not if the ground before it
        rests: movers that travel together look like a path among things that are all far away.
        """
        if self.parallax or (self._exceeds(RESIDUAL_RATIO, FLOOR_PX) and not self.by_ground):
            return "moving"
        if self.flow_px > STILL_PX:
            return "rotating"
        return "rotating" if self.turns and self.slow and not self._exceeds(DOUBT, 0.0) else "near-still"

    @property
    def slow(self) -> bool:
        """Whether the flow is that of a camera which hardly moves, or turns slowly."""
        return TURNS_PX < self.flow_px <= STILL_PX

    @property
    def by_ground(self) -> bool:
        """Whether ground at rest outweighs the residual of a rotation, which movers may leave, and no path is known."""
        rests = self.ground is not None and self.ground >= AT_REST
        return rests and not self.parallax and self._exceeds(RESIDUAL_RATIO, FLOOR_PX)

    @property
    def doubtful(self) -> bool:
        """Whether the ground moves, or a rotation leaves more than most noise does, small as it is against FLOOR_PX."""
        if self.ground is not None and self.ground < MOVES:
            return True
        return max(self.rotation_1_px, self.rotation_px) > FLOOR_PX and self._exceeds(DOUBT, 0.0)

    def _exceeds(self, ratio: float, floor_px: float) -> bool:
        """Whether a rotation leaves `ratio` times what noise does, which is taken to be at least `floor_px`."""
        pairs = (self.rotation_1_px, self.sampson_1_px), (self.rotation_px, self.sampson_px)
        return any(turned >= ratio * NOISE_RATIO * max(noise, floor_px) for turned, noise in pairs)

    @property
    def dominant_plane(self) -> bool:
        """Whether one plane explains half of the view of a moving camera: two-view fits may then be degenerate."""
        return self.camera == "moving" and self.homography_px < RESIDUAL_RATIO * max(self.sampson_px, FLOOR_PX)

    @property
    def planar(self) -> bool:
        """Whether one plane explains most of the view of a moving camera."""
        limit = RESIDUAL_RATIO * max(self.most_sampson_px, FLOOR_PX)
        return self.camera == "moving" and self.most_homography_px < limit


def longest_step(graph: FlowGraph) -> int:
    """The largest frame distance, of at most REACH frames, that is still matched well."""
    length, confident = np.abs(graph.target - graph.source), (graph.weights > MIN_WEIGHT).sum(axis=1)
    steps = np.unique(length[length <= REACH]).tolist()
    usual = {step: float(np.median(confident[length == step])) for step in steps}
    return max(step for step, count in usual.items() if count >= MATCHED * usual[min(usual)])


def measure(graph: FlowGraph, focal_px: float | None, seed: int, baseline: int = BASELINE) -> Statistics:
    """Statistics of the matches at a known focal length, or else at the one that fits a rotation best.

    A focal length a few per cent off leaves residuals of whole pixels on a pan, far above the noise. So the focal
    length is optimised and not picked from a list.
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
    """At most PAIRS pairs of frames at this distance with enough matches, spread over the sequence."""
    pairs = [(i, i + offset) for i in range(graph.T - offset)]
    usable = [pair for pair in pairs if len(_rays(graph, pair, 1.0)[0]) >= MIN_MATCHES]
    return [usable[k] for k in np.unique(np.linspace(0, len(usable) - 1, PAIRS).astype(int))] if usable else []


def _rays(graph: FlowGraph, pair: tuple[int, int], focal_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return twoview.pair_rays(graph, *pair, focal_px)


def _rotation_focal(graph: FlowGraph, pairs: list[tuple[int, int]]) -> float:
    """The focal length in px, within the range FOCALS, that minimises the rotation residual of these pairs."""

    def left(log_focal: float) -> float:
        return _median([_rotation(graph, pair, float(np.exp(log_focal))) for pair in pairs])

    logs = np.log(FOCALS * graph.long_side_px)
    best = int(np.argmin([left(log_focal) for log_focal in logs]))
    if not pairs:
        return float(np.exp(logs[best]))
    bounds = logs[max(best - 1, 0)], logs[min(best + 1, len(logs) - 1)]
    found = minimize_scalar(left, bounds=bounds, method="bounded", options={"xatol": FOCAL_TOLERANCE})
    return float(np.exp(found.x))


def _rotation(graph: FlowGraph, pair: tuple[int, int], focal_px: float) -> float:
    return float(np.median(twoview.fit_rotation(*_rays(graph, pair, focal_px), focal_px)[1]))


def _sampson(graph: FlowGraph, pair: tuple[int, int], focal_px: float, seed: int) -> np.ndarray:
    """Sampson distances [n] in px from the fitted epipolar geometry; infinite if none can be fitted."""
    x, y, w = _rays(graph, pair, focal_px)
    fit = twoview.estimate_motion(x, y, w, focal_px, TWO_VIEW_PX, seed)
    if fit is None:
        return np.full(1, np.inf)
    return np.asarray(np.abs(twoview.sampson_errors(fit.R, fit.t, x, y)) * focal_px)


def _homography(graph: FlowGraph, pair: tuple[int, int]) -> np.ndarray:
    """Residuals [n] in px from a fitted homography; infinite if none can be fitted."""
    x, y, _ = _rays(graph, pair, 1.0)
    H, _ = cv2.findHomography(x, y, cv2.RANSAC, 1.0)
    if H is None:
        return np.full(1, np.inf)
    return np.asarray(np.linalg.norm(cv2.perspectiveTransform(x[None], H)[0] - y, axis=1))


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if len(values) else float("inf")
