"""Evidence of motion gathered over neighbouring pixels and, along the flow, over neighbouring frames."""

import cv2
import numba
import numpy as np

from stages.motion.epipolar import Evidence
from stages.shared.threads import spread, threaded
from stages.shared.warp import warp

MIN_WEIGHT = 0.1
POOLED_OFFSETS = (1, 2)
PRIOR_WEIGHT = 0.3
"""Weight of the prior that a pixel is static (residual 0): a pixel without evidence counts as static."""
REFERENCE_WIDTH = 512
SMOOTHNESS = 100.0
"""Weight of edge-aware smoothing for frames of REFERENCE_WIDTH: evidence spreads over some ten pixels."""
COLOUR_SIGMA = 4.0
"""Colour step (0..255) that stops the smoothing."""


def evidence_weights(flow: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    """Weights [E, h, w] float32 of flow [E, h, w, 2] px as evidence of motion: its confidence, with a small minimum.

    Objects that move fast or rotate are matched badly in every pair. Flow that fits neither a static world nor the
    backward flow is weak evidence of motion, and often the only one. Flow that leaves the frame has weight 0.
    """
    weights = confidence.astype(np.float32)  # half precision is slow to compare
    spread(_weigh, len(weights), flow.astype(np.float32, copy=False), weights)
    return weights


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _weigh(first, last, flow, weights):  # type: ignore[no-untyped-def]
    _, h, w = weights.shape
    for e in range(first, last):
        confident = 0
        for y in range(h):
            for x in range(w):
                confident += weights[e, y, x] > 0.5
        floor = np.float32(MIN_WEIGHT * confident / (h * w))
        for y in range(h):
            for x in range(w):
                u, v = x + flow[e, y, x, 0], y + flow[e, y, x, 1]
                inside = u >= 0 and u <= w - 1 and v >= 0 and v <= h - 1
                weights[e, y, x] = max(weights[e, y, x], floor) if inside else np.float32(0)


def pool(
    evidence: Evidence,
    rgb: np.ndarray,
    edges: dict[tuple[int, int], int],
    flow: np.ndarray,
    weights: np.ndarray,
) -> np.ndarray:
    """Weighted mean residual [T, h, w] in 0..1 over similar pixels and over the frames one and two away.

    Within a frame, evidence spreads up to colour edges in proportion to its weight: well-matched pixels decide for
    badly matched ones.

    Args:
        rgb: [T, h, w, 3] uint8 frames on the flow grid.
        edges: (source, target) -> row of flow [E, h, w, 2] px and weights [E, h, w].
    """
    numerator, denominator = np.stack(threaded(_spread, *evidence, rgb), axis=1)

    def of_frame(frame: int) -> np.ndarray:
        pooled, total = numerator[frame].copy(), denominator[frame].copy()
        for (i, j), e in edges.items():
            if i == frame and abs(i - j) in POOLED_OFFSETS:
                pooled += weights[e] * warp(numerator[j], flow[e])
                total += weights[e] * warp(denominator[j], flow[e])
        return np.asarray(pooled / (total + PRIOR_WEIGHT))

    return np.stack(threaded(of_frame, range(len(numerator))))


def _spread(residual: np.ndarray, weight: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """Weighted residual and weight of a frame, [2, h, w], both smoothed up to its colour edges.

    Their ratio is a normalised convolution (Knutsson and Westin, CVPR 1993) by the fast global smoother (Min et al.,
    TIP 2014), whose reach in pixels grows with the root of its weight: hence the squared width.
    """
    smoothness = SMOOTHNESS * (rgb.shape[1] / REFERENCE_WIDTH) ** 2
    smoother = cv2.ximgproc.createFastGlobalSmootherFilter(rgb, smoothness, COLOUR_SIGMA)
    return np.stack([smoother.filter(image.astype(np.float32)) for image in (residual * weight, weight)])
