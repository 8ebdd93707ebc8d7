"""Evidence of motion gathered over neighbouring pixels and, along the flow, over neighbouring frames."""

import cv2
import numpy as np

from stages.motion.epipolar import Evidence
from stages.shared.flow_pairs import FlowPairs
from stages.shared.images import relative_size
from stages.shared.threads import threaded
from stages.shared.warp import warp

POOLED_OFFSETS = (1, 2)
PRIOR_WEIGHT = 0.3
"""Weight of the prior that a pixel is static (residual 0): a pixel without evidence counts as static."""
SMOOTHNESS = 100.0
"""Weight of edge-aware smoothing for frames of REFERENCE_PX: evidence spreads over some ten pixels."""
COLOUR_SIGMA = 4.0
"""Colour step (0..255) that stops the smoothing."""


def pool(evidence: Evidence, rgb: np.ndarray, pairs: FlowPairs) -> np.ndarray:
    """Weighted mean residual [T, h, w] in 0..1 over similar pixels and over the frames one and two away.

    Within a frame, evidence spreads up to colour edges in proportion to its weight: well-matched pixels decide for
    badly matched ones.

    Args:
        rgb: [T, h, w, 3] uint8 frames on the flow grid.
    """
    pooled = np.empty(evidence.residual.shape, np.float32)
    T, reach = len(pooled), max(POOLED_OFFSETS)
    for first, last in pairs.blocks(T, "pooling"):
        near = slice(max(first - reach, 0), min(last + reach, T))
        sums = threaded(spread, evidence.residual[near], evidence.weight[near], rgb[near])
        of_frame = dict(zip(range(near.start, near.stop), sums, strict=True))
        pooled[first:last] = threaded(lambda k, sums=of_frame: _pooled(k, sums, pairs), range(first, last))
    return pooled


def _pooled(frame: int, sums: dict[int, np.ndarray], pairs: FlowPairs) -> np.ndarray:
    """The mean residual [h, w] of a frame, from the sums [2, h, w] of it and its neighbours."""
    pooled, total = sums[frame].copy()
    for e in pairs.leaving(frame, frame + 1):
        j = int(pairs.target[e])
        if abs(frame - j) in POOLED_OFFSETS:
            flow, weights = pairs.flow[e].astype(np.float32), pairs.weights(e)
            pooled += weights * warp(sums[j][0], flow)
            total += weights * warp(sums[j][1], flow)
    return np.asarray(pooled / (total + PRIOR_WEIGHT))


def spread(residual: np.ndarray, weight: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """Weighted residual and weight of a frame, [2, h, w], both smoothed up to its colour edges.

    Their ratio is a normalised convolution (Knutsson and Westin, CVPR 1993) by the fast global smoother (Min et al.,
    TIP 2014), whose reach in pixels grows with the root of its weight: hence the squared size.
    """
    smoothness = SMOOTHNESS * relative_size(rgb) ** 2
    smoother = cv2.ximgproc.createFastGlobalSmootherFilter(rgb, smoothness, COLOUR_SIGMA)
    return np.stack([smoother.filter(image.astype(np.float32)) for image in (residual * weight, weight)])
