"""Scores of binary masks: overlap and boundary accuracy, as in the DAVIS benchmark."""

from collections.abc import Iterable

import cv2
import numpy as np

BOUNDARY_SHARE = 0.008  # of the image diagonal: the distance at which boundaries still match (Perazzi et al. 2016)
PROTOCOL = (
    "IoU and boundary F per frame, then the mean over frames (a frame empty in both counts 1); boundary F: harmonic "
    "mean of boundary precision and recall within 0.8 % of the diagonal (DAVIS); precision and recall over the pixels "
    "of all frames together, n/a where no pixel is called or truly dynamic; movers at rest too: with all that moves in "
    "any frame of the clip, also where it rests (mover_mask; n/a without)"
)


def iou(mask: np.ndarray, truth: np.ndarray) -> float:
    """Intersection over union of masks [H, W] bool, 0..1; 1 if both are empty."""
    union = np.count_nonzero(mask | truth)
    return float(np.count_nonzero(mask & truth) / union) if union else 1.0


def precision_recall(frames: Iterable[tuple[np.ndarray, np.ndarray]]) -> tuple[float | None, float | None]:
    """Shares of the pixels called dynamic that move, and of those that move that are called so.

    Args:
        frames: mask and true mask [H, W] of each frame.
    """
    counts = [tuple(map(np.count_nonzero, (mask & truth, mask, truth))) for mask, truth in frames]
    found, called, moving = np.sum(counts, axis=0, dtype=int).tolist() if counts else (0, 0, 0)
    return found / called if called else None, found / moving if moving else None


def boundary_f(mask: np.ndarray, truth: np.ndarray) -> float:
    """Harmonic mean of the shares of each boundary that lie near the other one, 0..1; 1 if both have none."""
    edge, true_edge = boundary(mask), boundary(truth)
    if not edge.any() and not true_edge.any():
        return 1.0
    if not edge.any() or not true_edge.any():
        return 0.0
    reach_px = np.ceil(BOUNDARY_SHARE * np.hypot(*mask.shape))
    precision = float(np.mean(_distance_px(true_edge)[edge] <= reach_px))
    recall = float(np.mean(_distance_px(edge)[true_edge] <= reach_px))
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


def boundary(mask: np.ndarray) -> np.ndarray:
    """Pixels [H, W] bool that differ from their right, lower or lower right neighbour."""
    padded = np.pad(mask, ((0, 1), (0, 1)), mode="edge")
    return np.asarray((mask != padded[:-1, 1:]) | (mask != padded[1:, :-1]) | (mask != padded[1:, 1:]))


def _distance_px(edge: np.ndarray) -> np.ndarray:
    """Distance [H, W] of every pixel to the nearest pixel of `edge`."""
    return np.asarray(cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE))
