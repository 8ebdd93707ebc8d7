"""From a motion prior to masks: edge-aware smoothing, a vote along the flow, hysteresis."""

import cv2
import numpy as np

from stages.shared.images import enlarge
from stages.shared.warp import warp

REFERENCE_WIDTH = 512
VOTE_OFFSETS = (1, 2)


def smooth_along_edges(probability: np.ndarray, rgb: np.ndarray, smoothness: float, colour_sigma: float) -> np.ndarray:
    """The prior [h, w] spread over the frame rgb [H, W, 3] uint8 up to its colour edges, [H, W] float32 in 0..1.

    Weighted least squares: min_u sum (u - p)^2 + smoothness * sum exp(-|colour step| / colour_sigma) |grad u|^2, by the
    fast global smoother (Min et al., TIP 2014). The reach in pixels grows with the root of the weight, hence the
    scaling by the squared frame width.
    """
    H, W = rgb.shape[:2]
    prior = enlarge(probability.astype(np.float32), (W, H))
    weight = smoothness * (W / REFERENCE_WIDTH) ** 2
    smoothed = cv2.ximgproc.fastGlobalSmootherFilter(rgb, prior, weight, colour_sigma)
    return np.asarray(np.clip(smoothed, 0, 1))


def vote(
    probability: np.ndarray, edges: dict[tuple[int, int], int], flow: np.ndarray, confidence: np.ndarray
) -> np.ndarray:
    """Mean probability [T, h, w] of each pixel and of what the flow matches it with one and two frames away.

    Args:
        edges: (source, target) -> row of flow [E, h, w, 2] px and confidence [E, h, w], which weighs the vote.
    """
    total = probability.astype(np.float32)
    weight = np.ones_like(total)
    for (i, j), e in edges.items():
        if abs(i - j) in VOTE_OFFSETS:
            trust = confidence[e].astype(np.float32)
            total[i] += trust * warp(probability[j].astype(np.float32), flow[e].astype(np.float32))
            weight[i] += trust
    return np.asarray(total / weight)


def to_mask(probability: np.ndarray, high: float, low: float, min_area: float) -> np.ndarray:
    """Mask [H, W] bool by hysteresis: connected regions above `low` that reach `high` somewhere.

    Regions, and holes in them, below `min_area` (a share of the frame) are dropped, respectively filled.
    """
    pixels = min_area * probability.size
    count, labels, stats, _ = cv2.connectedComponentsWithStats((probability > low).astype(np.uint8))
    keep = np.zeros(count, bool)
    keep[np.unique(labels[probability > high])] = True
    keep &= stats[:, cv2.CC_STAT_AREA] >= pixels
    keep[0] = False
    mask = keep[labels]
    _, holes, hole_stats, _ = cv2.connectedComponentsWithStats((~mask).astype(np.uint8))
    small = hole_stats[:, cv2.CC_STAT_AREA] < pixels
    small[0] = False
    return np.asarray(mask | small[holes])


def guarded_thresholds(probability: np.ndarray, high: float, low: float, max_share: float) -> tuple[float, float]:
    """Thresholds raised, where needed, so that at most `max_share` of the frame [H, W] lies above `low`.

    A mask over nearly the whole frame leaves no static area to estimate poses from; only its surest part is kept.
    """
    guarded = max(low, float(np.quantile(probability, 1 - max_share)))
    return max(high, guarded), guarded
