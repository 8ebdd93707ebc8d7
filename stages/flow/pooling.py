"""Evidence of motion gathered over neighbouring pixels and, along the flow, over neighbouring frames."""

import cv2
import numpy as np

from stages.flow.epipolar import Evidence
from stages.shared.warp import warp

POOLED_OFFSETS = (1, 2)
PRIOR_WEIGHT = 0.3
"""Confidence that a pixel needs before its misfit counts: without evidence a pixel is taken as static."""
BLUR_PX = 1.0


def pool(evidence: Evidence, edges: dict[tuple[int, int], int], flow: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    """Mean misfit [T, h, w] in 0..1, weighted by its evidence, over a small blur and the frames one and two away.

    Args:
        edges: (source, target) -> row of flow [E, h, w, 2] px and confidence [E, h, w].
    """
    numerator = np.stack([cv2.GaussianBlur(m * w, (0, 0), BLUR_PX) for m, w in zip(*evidence, strict=True)])
    denominator = np.stack([cv2.GaussianBlur(w, (0, 0), BLUR_PX) for w in evidence.weight])
    pooled, total = numerator.copy(), denominator.copy()
    for (i, j), e in edges.items():
        if abs(i - j) in POOLED_OFFSETS:
            pooled[i] += confidence[e] * warp(numerator[j], flow[e])
            total[i] += confidence[e] * warp(denominator[j], flow[e])
    return pooled / (total + PRIOR_WEIGHT)
