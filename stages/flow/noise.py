"""Noise of the camera: how far it hides texture, and frames averaged along their flow where it does."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from stages.flow.edges import Edge
from stages.shared.warp import is_inside, warp

MIN_NOISE = 0.29
"""Noise of 8-bit rounding, in grey levels."""
BLUR_PX, TEXTURE_WINDOW_PX = 1.5, 15
HIDDEN_PX, COARSE_PX = 0.4, 0.6
"""Noise that makes flow err by more than the first at the median pixel (by day it is 0.03 to 0.2) is averaged away.

Where more than the second is left, full size is not searched: patches of 8 px hold little but noise.
"""
REACH = (1, 2)
"""Frames are averaged with those so many frames before and after them."""
MATCH_BLUR_PX, MATCH_SIGMAS = 2.0, 2.0
"""What differs after this blur by more than so many standard deviations of the noise shows something else."""
SHARED = 3.0
"""Two averaged frames show the same noise where the flow put it, so that it errs by more than what is left predicts."""
SUPPORT_PX, NO_TEXTURE = 31, 4.0
"""Flow against noise takes its surroundings along: it needs texture there too. Beyond this variance, px^2, is none."""


def noise_variance(image: np.ndarray) -> float:
    """Variance of the noise of a grey frame [h, w] uint8, in squared grey levels.

    Immerkaer, CVIU 1996; by the median, which edges disturb less.
    """
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    response = np.abs(cv2.filter2D(image, cv2.CV_32F, kernel))
    return max(float(np.median(response)) / 0.6745 / 6, MIN_NOISE) ** 2


def flow_variance(image: np.ndarray, noise: float | np.ndarray | None = None) -> np.ndarray:
    """Variance [h, w] px^2 that noise causes in flow along the worst direction of a window (Cramer-Rao bound).

    The noise of two frames over the smaller eigenvalue of the structure tensor, less what noise itself adds to that.

    Args:
        image: [h, w] uint8 grey frame.
        noise: variance of its noise, of all pixels or per pixel [h, w]; None: estimated.
    """
    noise = noise_variance(image) if noise is None else noise
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), BLUR_PX)
    gx, gy = (cv2.Sobel(smooth, -1, *order, ksize=3, scale=1 / 8) for order in ((1, 0), (0, 1)))
    window = (TEXTURE_WINDOW_PX, TEXTURE_WINDOW_PX)
    xx, yy, xy = (cv2.blur(product, window) for product in (gx * gx, gy * gy, gx * gy))
    eigenvalue = (xx + yy) / 2 - np.sqrt((xx - yy) ** 2 / 4 + xy**2) - noise / (8 * np.pi * BLUR_PX**4)
    # Of two flat directions any is as bad as the other: 1e-9 keeps the quotient finite.
    return np.asarray(2 * noise / (np.maximum(eigenvalue, 1e-9) * TEXTURE_WINDOW_PX**2))


def hides_texture(grey: np.ndarray, variances: Sequence[np.ndarray]) -> bool:
    """Whether noise, more than the rounding to 8 bits, leaves half of the flow of frames [T, h, w] uint8 a guess.

    Args:
        variances: `flow_variance` [h, w] of every frame.
    """
    loud = noise_variance(grey[len(grey) // 2]) > MIN_NOISE**2
    return bool(loud and typical_variance(variances) > HIDDEN_PX**2)


def typical_variance(variances: Sequence[np.ndarray]) -> float:
    """Median over frames and pixels of `flow_variance` [h, w]."""
    return float(np.median([np.median(variance[::4, ::4]) for variance in variances]))


def quiet_grey(rgb: np.ndarray) -> np.ndarray:
    """Grey frames [T, h, w] float32 of frames [T, h, w, 3] uint8 with the least noise: channels by inverse variance."""
    channels = rgb[len(rgb) // 2]
    weights = np.array([1 / noise_variance(np.ascontiguousarray(channels[..., c])) for c in range(3)], np.float32)
    return np.asarray(rgb @ (weights / weights.sum()))


def averaged(grey: np.ndarray, flow: Mapping[Edge, np.ndarray], i: int, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Frame i averaged with its neighbours along the flow, [h, w] uint8, and the variance [h, w] of its noise left.

    A neighbour counts where it shows the same thing but for noise; not where it is hidden or the flow is wrong.

    Args:
        grey: [T, h, w] float32 frames; flow: [h, w, 2] px of edges from frame i; noise: variance of a frame's noise.
    """
    total, weights, squares = grey[i].copy(), np.ones_like(grey[i]), np.ones_like(grey[i])
    limit = MATCH_SIGMAS**2 * 2 * noise / (4 * np.pi * MATCH_BLUR_PX**2)
    for step in (*(-d for d in REACH), *REACH):
        if (i, i + step) in flow:
            there = warp(grey[i + step], flow[i, i + step])
            difference = there - grey[i]
            difference -= np.median(difference[::2, ::2])
            unlike = cv2.GaussianBlur(difference, (0, 0), MATCH_BLUR_PX) ** 2 / limit
            weight = np.exp(-unlike / 2) * is_inside(flow[i, i + step])
            total += weight * (grey[i] + difference)
            weights += weight
            squares += weight**2
    return np.rint(np.clip(total / weights, 0, 255)).astype(np.uint8), noise * squares / weights**2


def averaged_variance(image: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """`flow_variance` [h, w] of an averaged frame [h, w] uint8 with noise of variance [h, w], nowhere too low."""
    variance = flow_variance(image, noise)
    around = cv2.blur(np.minimum(variance, NO_TEXTURE), (SUPPORT_PX, SUPPORT_PX))
    return np.asarray(SHARED * np.maximum(variance, around))
