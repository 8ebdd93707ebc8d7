"""Whether a frame continues the one before, shows nothing, or repeats another."""

import cv2
import numpy as np

from stages.shared.quick_flow import quick_flow

SAME_SHOT, SAME_SHOT_FINE = 0.35, 0.48
"""Least correlation of a frame with the one before, warped onto it, within a shot: by coarse flow, and by fine flow.

Fine flow also makes frames of different clips alike. Of 870 pairs of neighbouring frames of 24 clips (the tuned scenes,
Sintel, one hand-held) the least was 0.53 by the flow that fits best; of 300 pairs of frames of different clips the
largest were 0.25 by coarse and 0.34 by fine flow, and 0.45 between smooth random textures.
"""
WINDOW_PX = 9
NOISE = 4.0
"""Variance that noise and coding may have; it keeps dark and flat areas from deciding."""
BLANK = 2 * NOISE
"""Variance within windows of frames that show nothing, as between fades: at less, noise makes any two frames alike. The
least of the tuned scenes is 28, in fog."""
DUPLICATE_LEVELS = 4.0
BLOCK_PX = 16
"""A frame repeats the last one used if no block of this size, at 512 px along the longer side, changes by more than
these grey levels on average. H.264 at crf 20 changed repeated frames by at most 3.1 (at crf 28 by 3.7 in the median);
the slowest motion of the clips above changed frames by 10.4. Slower motion is thinned out: compared is the last frame
used."""


def continues(before: np.ndarray, after: np.ndarray) -> bool:
    """Whether a frame [h, w] uint8 continues the one before, by their correlation once warped by the flow between them.

    The correlation is that of windows about their means, which does not depend on exposure. Coarse flow decides nearly
    all pairs. Where it does not fit, it starts from the best translation, as fast pans need it; then fine flow is
    searched, both ways, for fast movers and few pixels in common.
    """
    fine = cv2.DISOPTICAL_FLOW_PRESET_MEDIUM
    return (
        continues_coarsely(before, after)
        or warped_correlation(before, after, fine) >= SAME_SHOT_FINE
        or warped_correlation(after, before, fine) >= SAME_SHOT_FINE
    )


def continues_coarsely(before: np.ndarray, after: np.ndarray) -> bool:
    """As `continues`, without fine flow."""
    coarse = cv2.DISOPTICAL_FLOW_PRESET_FAST
    return (
        warped_correlation(before, after, coarse) >= SAME_SHOT
        or warped_correlation(before, after, coarse, translation(before, after)) >= SAME_SHOT
    )


def warped_correlation(
    before: np.ndarray, after: np.ndarray, preset: int, start_px: tuple[float, float] = (0, 0)
) -> float:
    """Correlation of a frame [h, w] uint8 with the one before, warped by DIS flow from a first translation (x, y)."""
    start = np.broadcast_to(np.array(start_px, np.float32), (*after.shape, 2)).copy()
    flow = quick_flow(after, before, preset, start)
    v, u = np.indices(after.shape, np.float32)
    warped = cv2.remap(before, u + flow[..., 0], v + flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return correlation(warped, after)


def translation(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """The translation (x, y) px from `after` to `before` at which they correlate most in their details."""
    first, second = (
        image.astype(np.float32) - cv2.blur(image.astype(np.float32), (WINDOW_PX, WINDOW_PX))
        for image in (before, after)
    )
    (x, y), _ = cv2.phaseCorrelate(first, second, cv2.createHanningWindow(after.shape[::-1], cv2.CV_32F))
    return -x, -y


def shows_nothing(image: np.ndarray) -> bool:
    """Whether an image [h, w] uint8 is flat, as all black or all white."""
    return variance(image.astype(np.float32)) < BLANK


def variance(image: np.ndarray) -> float:
    """Variance of an image [h, w] float32 within windows, over all of them together."""
    size = WINDOW_PX, WINDOW_PX
    return float(np.mean(cv2.blur(image * image, size) - cv2.blur(image, size) ** 2))


def correlation(first: np.ndarray, second: np.ndarray) -> float:
    """Correlation of two images [h, w] within windows, over all of them together; 1 for flat images."""
    a, b = first.astype(np.float32), second.astype(np.float32)
    size = WINDOW_PX, WINDOW_PX
    shared = float(np.mean(cv2.blur(a * b, size) - cv2.blur(a, size) * cv2.blur(b, size))) + NOISE
    return shared / float(np.sqrt((variance(a) + NOISE) * (variance(b) + NOISE)))


def repeats(kept: np.ndarray, image: np.ndarray) -> bool:
    """Whether no block of an image [h, w] uint8 differs from that of the last one used by more than coding does."""
    changed = cv2.blur(cv2.absdiff(kept, image).astype(np.float32), (BLOCK_PX, BLOCK_PX))
    return bool(changed.max() < DUPLICATE_LEVELS)
