"""Evidence of motion gathered over neighbouring pixels and, along the flow, over neighbouring frames."""

import cv2
import numpy as np

from stages.flow.epipolar import Evidence
from stages.shared.warp import is_inside, warp

MIN_WEIGHT = 0.1
POOLED_OFFSETS = (1, 2)
PRIOR_WEIGHT = 0.3
"""Weight that a pixel needs before its misfit counts: without evidence a pixel is taken as static."""
BLUR_PX = 1.0


def evidence_weights(flow: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    """Weights [E, h, w] float32 of flow [E, h, w, 2] px as evidence of motion: its confidence, but not nothing.

    Things that move fast or turn are matched badly in every pair; flow that fits neither the static world nor itself
    is weak evidence of motion, and often the only one. Flow that leaves the frame says nothing.
    """
    weights = confidence.astype(np.float32)  # half precision is slow to compare
    for edge, weight in zip(flow, weights, strict=True):
        floor = np.float32(MIN_WEIGHT * (weight > 0.5).mean())
        weight[:] = np.maximum(weight, floor) * is_inside(edge)
    return weights


def pool(evidence: Evidence, edges: dict[tuple[int, int], int], flow: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Mean misfit [T, h, w] in 0..1, weighted by its evidence, over a small blur and the frames one and two away.

    Args:
        edges: (source, target) -> row of flow [E, h, w, 2] px and weights [E, h, w].
    """
    numerator = np.stack([cv2.GaussianBlur(m * w, (0, 0), BLUR_PX) for m, w in zip(*evidence, strict=True)])
    denominator = np.stack([cv2.GaussianBlur(w, (0, 0), BLUR_PX) for w in evidence.weight])
    pooled, total = numerator.copy(), denominator.copy()
    for (i, j), e in edges.items():
        if abs(i - j) in POOLED_OFFSETS:
            pooled[i] += weights[e] * warp(numerator[j], flow[e])
            total[i] += weights[e] * warp(denominator[j], flow[e])
    return pooled / (total + PRIOR_WEIGHT)
