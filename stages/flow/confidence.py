"""How far dense flow can be trusted, from what the two frames and the flow back say about it."""

import cv2
import numpy as np

from stages.flow.noise import flow_variance
from stages.shared.warp import is_inside, warp

NOISE_PX = 0.3
NOISE_PER_PX = 0.02
"""Expected disagreement of forward and backward flow: a floor and a share of the motion."""
FAST_PX = 30.0
ROUGH_PX = 0.35
"""Flow that varies this much within 7 x 7 px crosses a motion border, where it bleeds over by a few pixels."""
PHOTOMETRIC_LIMIT = 2.0
"""A photometric residual of this many times the frame's median is a mismatch."""

TEXTURELESS = 0.45
"""Without texture above the noise, flow is a guess from its surroundings: its confidence stays below one half."""


def flow_confidence(
    flow: np.ndarray, back: np.ndarray, source: np.ndarray, target: np.ndarray, textured: np.ndarray | None = None
) -> np.ndarray:
    """Confidence [h, w] float32 in 0..1 that flow [h, w, 2] px is right to a pixel.

    The product of four terms: forward-backward consistency with `back` (the flow of the target), smoothness,
    photometric residual between the grey frames source and target [h, w] uint8, and texture above the noise (that of
    the source is `textured` where it is known). Zero where the flow leaves the frame.
    Above 0.5 the true error is under 1 px for more than nine pixels in ten (benchmarks/flow_accuracy.py measures it),
    in fog at night, where few pixels are above it, about nine in ten from frame to frame and fewer further on.
    """
    disagreement = cv2.magnitude(*cv2.split(flow + warp(back, flow)))
    expected = NOISE_PX + NOISE_PER_PX * np.minimum(cv2.magnitude(*cv2.split(flow)), FAST_PX)
    consistent = 1 / (1 + (disagreement / expected) ** 2) ** 2
    smooth = 1 / (1 + _local_variance(flow) / ROUGH_PX**2)
    similar = 1 / (1 + (_photometric_ratio(flow, source, target) / PHOTOMETRIC_LIMIT) ** 4)
    textured = texture_confidence(flow_variance(source)) if textured is None else textured
    return np.asarray(consistent * smooth * similar * textured * is_inside(flow), np.float32)


def texture_confidence(variance: np.ndarray) -> np.ndarray:
    """The term [h, w] that tells texture from noise, TEXTURELESS..1, for a variance [h, w] px^2 of flow by noise."""
    return np.asarray(TEXTURELESS + (1 - TEXTURELESS) / (1 + variance))


def _local_variance(flow: np.ndarray) -> np.ndarray:
    """Variance of flow within 7 x 7 px, [h, w] px^2; taken about the mean flow, which keeps float32 exact."""
    u, v = (channel - np.float32(channel.mean()) for channel in cv2.split(flow))
    mean_u, mean_v, mean_square = (cv2.blur(values, (7, 7)) for values in (u, v, u * u + v * v))
    return np.asarray(np.maximum(mean_square - mean_u**2 - mean_v**2, 0))


def _photometric_ratio(flow: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Grey-level residual [h, w] after the flow, without the pair's change of exposure, over the frame's median."""
    difference = warp(target.astype(np.float32), flow) - source
    residual = cv2.blur(np.abs(difference - np.median(difference[::2, ::2])), (5, 5))
    # One grey level is the least that 8-bit frames resolve: textureless frames have no smaller residual.
    return np.asarray(residual / max(float(np.median(residual[::2, ::2])), 1.0))
