"""Confidence of dense flow, from the two frames and the backward flow."""

import cv2
import numpy as np

from stages.flow.noise import flow_variance
from stages.shared.warp import look_up, warp

NOISE_PX = 0.3
NOISE_PER_PX = 0.02
FAST_PX = 30.0
"""Expected forward-backward error: NOISE_PX, plus NOISE_PER_PX for each px of motion up to FAST_PX."""
ROUGH = 0.4
"""Standard deviation of flow about its affine fit within WINDOW x WINDOW px, as a share of that expected error, that
halves the confidence: at a motion boundary the flow of one side leaks to the other.

Affine flow is smooth: that of near ground before a moving camera changes by .4 px from row to row, which is a standard
deviation of .8 px. So is flow that leaks evenly over more than WINDOW px, which is left to the other terms.
"""
WINDOW = 7
FAR_PX = 30.0
"""Flow farther from its mean over the frame is squared in double precision, in twice the time: of (400 px)^2 single
precision resolves no variance below .01 px^2, which is what a confidence turns on."""
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
    returning, inside = look_up(back, flow)
    disagreement = cv2.magnitude(*cv2.split(flow + returning))
    expected = NOISE_PX + NOISE_PER_PX * np.minimum(cv2.magnitude(*cv2.split(flow)), FAST_PX)
    consistent = 1 / (1 + (disagreement / expected) ** 2) ** 2
    smooth = 1 / (1 + variance_about_plane(flow) / (ROUGH * expected) ** 2)
    similar = 1 / (1 + (photometric_ratio(flow, source, target) / PHOTOMETRIC_LIMIT) ** 4)
    textured = texture_confidence(flow_variance(source)) if textured is None else textured
    return np.asarray(consistent * smooth * similar * textured * inside, np.float32)


def texture_confidence(variance: np.ndarray) -> np.ndarray:
    """Texture term [h, w] in TEXTURELESS..1 for the variance [h, w] px^2 that noise causes in the flow."""
    return np.asarray(TEXTURELESS + (1 - TEXTURELESS) / (1 + variance))


def variance_about_plane(flow: np.ndarray) -> np.ndarray:
    """Variance of flow within WINDOW x WINDOW px about its affine fit, [h, w] px^2.

    Offsets have no mean in the window and are uncorrelated, so each explains its slope squared times their variance.
    The difference of means of squares cancels: hence the mean flow is subtracted first, and what is far from it is
    squared in double precision. At the image border the window is reflected, and affine flow with it is not.
    """
    offsets = np.arange(WINDOW, dtype=np.float32) - WINDOW // 2
    slope, mean = offsets / np.square(offsets).sum(), np.full(WINDOW, 1 / WINDOW, np.float32)
    left = np.zeros(flow.shape[:2], np.float32)
    for channel in cv2.split(flow):
        values = channel - np.float32(channel.mean())
        if np.abs(values).max() > FAR_PX:
            values = values.astype(np.float64)
        about = cv2.blur(values * values, (WINDOW, WINDOW)) - cv2.blur(values, (WINDOW, WINDOW)) ** 2
        for across, along in ((slope, mean), (mean, slope)):
            about -= cv2.sepFilter2D(values, -1, across, along) ** 2 * np.square(offsets).mean()
        left += about
    return np.maximum(left, 0)


def photometric_ratio(flow: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Photometric residual [h, w] as a multiple of the frame's median; a change of exposure in the pair is removed."""
    difference = warp(target.astype(np.float32), flow) - source
    residual = cv2.blur(np.abs(difference - np.median(difference[::2, ::2])), (5, 5))
    # Differences below one grey level cannot be resolved in 8-bit frames, though a textureless pair may have them.
    return np.asarray(residual / max(float(np.median(residual[::2, ::2])), 1.0))
