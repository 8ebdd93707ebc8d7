"""Confidence of dense flow, from the two frames and the backward flow."""

import cv2
import numpy as np

from stages.flow.noise import flow_variance
from stages.shared.warp import is_inside, warp

NOISE_PX = 0.3
NOISE_PER_PX = 0.02
FAST_PX = 30.0
"""Expected forward-backward error: NOISE_PX, plus NOISE_PER_PX for each px of motion up to FAST_PX."""
ROUGH_PX = 0.35
"""Standard deviation of flow within 7 x 7 px at a motion boundary, where the flow of one side leaks to the other."""
PHOTOMETRIC_LIMIT = 2.0
"""A photometric residual of this multiple of the frame's median halves the confidence."""

TEXTURELESS = 0.45
"""Least value of the texture term. Flow without texture above the noise is interpolated from its surroundings, so its
confidence stays below one half."""


def flow_confidence(
    flow: np.ndarray, back: np.ndarray, source: np.ndarray, target: np.ndarray, textured: np.ndarray | None = None
) -> np.ndarray:
    """Confidence [h, w] float32 in 0..1 that the error of flow [h, w, 2] px is below 1 px.

    The confidence is the product of four terms: forward-backward consistency, smoothness of the flow, photometric
    residual, and texture above the noise. It is zero where the flow leaves the frame.
    Of the pixels above 0.5 more than nine in ten have an error below 1 px (benchmarks/flow_accuracy.py measures it). In
    fog at night few pixels are above 0.5: about nine in ten of them are right between neighbouring frames, and fewer
    over longer edges.

    Args:
        back: [h, w, 2] px, flow from the target to the source.
        source, target: [h, w] uint8 grey frames.
        textured: [h, w], the `texture_confidence` of the source; None: computed here.
    """
    disagreement = cv2.magnitude(*cv2.split(flow + warp(back, flow)))
    expected = NOISE_PX + NOISE_PER_PX * np.minimum(cv2.magnitude(*cv2.split(flow)), FAST_PX)
    consistent = 1 / (1 + (disagreement / expected) ** 2) ** 2
    smooth = 1 / (1 + _local_variance(flow) / ROUGH_PX**2)
    similar = 1 / (1 + (photometric_ratio(flow, source, target) / PHOTOMETRIC_LIMIT) ** 4)
    textured = texture_confidence(flow_variance(source)) if textured is None else textured
    return np.asarray(consistent * smooth * similar * textured * is_inside(flow), np.float32)


def texture_confidence(variance: np.ndarray) -> np.ndarray:
    """Texture term [h, w] in TEXTURELESS..1 for the variance [h, w] px^2 that noise causes in the flow."""
    return np.asarray(TEXTURELESS + (1 - TEXTURELESS) / (1 + variance))


def _local_variance(flow: np.ndarray) -> np.ndarray:
    """Variance of flow within 7 x 7 px, [h, w] px^2; subtracting the mean flow first avoids cancellation in float32."""
    u, v = (channel - np.float32(channel.mean()) for channel in cv2.split(flow))
    mean_u, mean_v, mean_square = (cv2.blur(values, (7, 7)) for values in (u, v, u * u + v * v))
    return np.asarray(np.maximum(mean_square - mean_u**2 - mean_v**2, 0))


def photometric_ratio(flow: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Photometric residual [h, w] as a multiple of the frame's median; a change of exposure in the pair is removed."""
    difference = warp(target.astype(np.float32), flow) - source
    residual = cv2.blur(np.abs(difference - np.median(difference[::2, ::2])), (5, 5))
    # Differences below one grey level cannot be resolved in 8-bit frames, though a textureless pair may have them.
    return np.asarray(residual / max(float(np.median(residual[::2, ::2])), 1.0))
