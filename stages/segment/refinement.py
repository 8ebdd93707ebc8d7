"""From superpixels to masks at full resolution: boundaries on pixels, specks and holes."""

import cv2
import numpy as np

from stages.shared.images import enlarge, relative_size

SHOWN_WEIGHT = 0.8
"""Weight of what pictures show of a pixel, relative to that of its sureness: what is surest is not lost by it alone."""
COLOUR_WEIGHT = 2.0
"""Weight of what colours say, where they are asked: clear ones may outvote all else."""


def smooth_along_edges(
    image: np.ndarray,
    rgb: np.ndarray,
    smoothness: float,
    colour_sigma: float,
    shown: np.ndarray | None = None,
    colours: np.ndarray | None = None,
) -> np.ndarray:
    """An image [h, w] in 0..1 spread over the frame rgb [H, W, 3] uint8 up to its colour edges, [H, W] float32 in 0..1.

    Weighted least squares: min_u sum (u - p)^2 + smoothness * sum exp(-|colour step| / colour_sigma) |grad u|^2, by the
    fast global smoother (Min et al., TIP 2014). The reach in pixels grows with the root of the weight, hence the
    scaling by the squared size of the frame.

    Args:
        shown: [h, w] in -1..1, what pictures show of each pixel: with a weight of SHOWN_WEIGHT |shown| it is averaged
            with the image, as 1 where it is positive, as 0 where it is negative (normalised convolution, Knutsson and
            Westin, CVPR 1993).
        colours: [H, W] in -1..1, what `colour_evidence` says of each, likewise with a weight of COLOUR_WEIGHT.
    """
    H, W = rgb.shape[:2]
    weight = smoothness * relative_size(rgb) ** 2
    smoother = cv2.ximgproc.createFastGlobalSmootherFilter(rgb, weight, colour_sigma)
    full = enlarge(image.astype(np.float32), (W, H))
    says = np.zeros((H, W), np.float32)
    if shown is not None:
        says += SHOWN_WEIGHT * enlarge(shown.astype(np.float32), (W, H))
    if colours is not None:
        says += COLOUR_WEIGHT * colours
    if not says.any():
        return np.asarray(np.clip(smoother.filter(full), 0, 1))
    smoothed = smoother.filter(full + np.maximum(says, 0)) / smoother.filter(1 + np.abs(says))
    return np.asarray(np.clip(smoothed, 0, 1))


def to_mask(sureness: np.ndarray, threshold: float, min_area: float) -> np.ndarray:
    """Mask [H, W] bool of the pixels above a threshold.

    Regions, and holes in them, below `min_area` (a share of the frame) are dropped, respectively filled.
    """
    pixels = min_area * sureness.size
    mask = _without_small(sureness > threshold, pixels)
    return ~_without_small(~mask, pixels)


def guarded_threshold(sureness: np.ndarray, threshold: float, max_share: float) -> float:
    """The threshold raised, where needed, so that at most `max_share` of the frame [H, W] lies above it.

    A mask over nearly the whole frame leaves no static area to estimate poses from; only its surest part is kept.
    Where nothing is surer than the rest the threshold stays: the adjustment ignores masks of whole frames.
    """
    if (sureness > threshold).mean() <= max_share:
        return threshold
    raised = max(threshold, float(np.quantile(sureness, 1 - max_share)))
    return raised if (sureness > raised).mean() > max_share / 2 else threshold


def to_instances(mask: np.ndarray, instances: np.ndarray) -> np.ndarray:
    """Instance numbers [H, W] uint16 of the pixels of a mask [H, W]: those of the nearest of the numbers [h, w] > 0.

    0 outside the mask, and everywhere if there is no number.
    """
    if not (instances > 0).any():
        return np.zeros(mask.shape, np.uint16)
    _, nearest = cv2.distanceTransformWithLabels(
        (instances == 0).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    number_of = np.zeros(nearest.max() + 1, np.uint16)
    number_of[nearest[instances > 0]] = instances[instances > 0]
    full = cv2.resize(number_of[nearest], mask.shape[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
    return np.where(mask, full, 0).astype(np.uint16)


def _without_small(mask: np.ndarray, pixels: float) -> np.ndarray:
    """The mask [H, W] without connected regions of fewer pixels."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    keep = stats[:, cv2.CC_STAT_AREA] >= pixels
    keep[0] = False
    return np.asarray(keep[labels])
