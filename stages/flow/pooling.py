"""Evidence of motion gathered over neighbouring pixels and, along the flow, over neighbouring frames."""

import cv2
import numba
import numpy as np

from stages.flow.epipolar import Evidence
from stages.shared.threads import threaded
from stages.shared.warp import warp

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
    _weigh(flow.astype(np.float32, copy=False), weights)
    return weights


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _weigh(flow, weights):  # type: ignore[no-untyped-def]
    E, h, w = weights.shape
    for e in numba.prange(E):
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


def pool(evidence: Evidence, edges: dict[tuple[int, int], int], flow: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Mean misfit [T, h, w] in 0..1, weighted by its evidence, over a small blur and the frames one and two away.

    Args:
        edges: (source, target) -> row of flow [E, h, w, 2] px and weights [E, h, w].
    """
    numerator = np.stack([cv2.GaussianBlur(m * w, (0, 0), BLUR_PX) for m, w in zip(*evidence, strict=True)])
    denominator = np.stack([cv2.GaussianBlur(w, (0, 0), BLUR_PX) for w in evidence.weight])

    def of_frame(frame: int) -> np.ndarray:
        pooled, total = numerator[frame].copy(), denominator[frame].copy()
        for (i, j), e in edges.items():
            if i == frame and abs(i - j) in POOLED_OFFSETS:
                pooled += weights[e] * warp(numerator[j], flow[e])
                total += weights[e] * warp(denominator[j], flow[e])
        return np.asarray(pooled / (total + PRIOR_WEIGHT))

    return np.stack(threaded(of_frame, range(len(numerator))))
