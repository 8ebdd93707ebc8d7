"""Image noise: how far it hides texture, and averaging of frames over time along their flow where it does."""

from collections.abc import Iterable, Mapping

import cv2
import numpy as np

from stages.flow.edges import Edge
from stages.flow.frames import Images
from stages.shared.image_noise import MIN_NOISE, noise_variance
from stages.shared.warp import look_up

BLUR_PX, TEXTURE_WINDOW_PX = 1.5, 15
"""Standard deviation of the blur before the gradients, and side of the structure tensor's window."""
HIDDEN_PX, COARSE_PX = 0.4, 0.6
"""Limits of the flow error that noise causes at the median pixel (standard deviation; in daylight 0.03 to 0.2 px).

Above the first limit the frames are averaged over time. If it is above the second after that, flow is not searched at
full size: patches of 8 px contain little but noise.
"""
REACH = (1, 2)
"""Frame distances, before and after, of the frames that enter an average."""
MATCH_BLUR_PX, MATCH_SIGMAS = 2.0, 2.0
"""Blur of the difference between two aligned frames, and the blurred difference, in standard deviations of its noise,
beyond which the other frame hardly counts: it shows another surface there."""
SHARED = 3.0
"""Factor on the variance of flow between averaged frames. They share noise that the flow has aligned, so flow errors
are larger than the remaining noise predicts."""
SUPPORT_PX, NO_TEXTURE = 31, 4.0
"""In strong noise flow depends on a window of SUPPORT_PX, so texture is needed there too. A variance above NO_TEXTURE
(px^2) counts as no texture."""


def flow_variance(image: np.ndarray, noise: float | np.ndarray | None = None) -> np.ndarray:
    """Variance [h, w] px^2 that noise causes in flow, in the worst direction (Cramer-Rao bound over a window).

    It is the noise variance of two frames, divided by the smaller eigenvalue of the structure tensor. The contribution
    of the noise to that eigenvalue is subtracted.

    Args:
        image: [h, w] uint8 or float32 grey frame.
        noise: variance of its noise in squared grey levels, for all pixels or per pixel [h, w]; None: estimated.
    """
    noise = noise_variance(image) if noise is None else noise
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), BLUR_PX)
    gx, gy = (cv2.Sobel(smooth, -1, *order, ksize=3, scale=1 / 8) for order in ((1, 0), (0, 1)))
    window = (TEXTURE_WINDOW_PX, TEXTURE_WINDOW_PX)
    xx, yy, xy = (cv2.blur(product, window) for product in (gx * gx, gy * gy, gx * gy))
    eigenvalue = (xx + yy) / 2 - np.sqrt((xx - yy) ** 2 / 4 + xy**2) - noise / (8 * np.pi * BLUR_PX**4)
    # Without texture the eigenvalue can be zero or below: 1e-9 keeps the quotient finite.
    return np.asarray(2 * noise / (np.maximum(eigenvalue, 1e-9) * TEXTURE_WINDOW_PX**2))


def hides_texture(grey: np.ndarray | Images, variances: Iterable[np.ndarray]) -> bool:
    """Whether noise beyond 8-bit rounding makes flow between frames [T, h, w] uint8 unreliable at the median pixel.

    Args:
        variances: `flow_variance` [h, w] px^2 of every frame; not asked for where the noise is no more than rounding.
    """
    loud = noise_variance(grey[len(grey) // 2]) > MIN_NOISE**2
    return bool(loud and typical_variance(variances) > HIDDEN_PX**2)


def typical_variance(variances: Iterable[np.ndarray]) -> float:
    """Median over frames and pixels of `flow_variance` [h, w], in px^2."""
    return float(np.median([np.median(variance[::4, ::4]) for variance in variances]))


def quiet_weights(rgb: np.ndarray) -> np.ndarray:
    """Weights [3] float32 of the channels of a frame [h, w, 3] uint8 in a quiet grey one: by inverse noise variance."""
    weights = np.array([1 / noise_variance(np.ascontiguousarray(rgb[..., c])) for c in range(3)], np.float32)
    return np.asarray(weights / weights.sum())


def averaged(
    grey: np.ndarray | Images, flow: Mapping[Edge, np.ndarray], i: int, noise: float
) -> tuple[np.ndarray, np.ndarray]:
    """Frame i averaged with its neighbours along the flow, [h, w] uint8, and the variance [h, w] of the noise left.

    A neighbour counts where it differs from frame i by no more than noise; not at occlusions or where the flow is
    wrong.

    Args:
        grey: [T, h, w] float32 frames. flow: [h, w, 2] px of the edges from frame i.
        noise: variance of the noise of a frame, in squared grey levels.
    """
    total, weights, squares = grey[i].copy(), np.ones_like(grey[i]), np.ones_like(grey[i])
    limit = MATCH_SIGMAS**2 * 2 * noise / (4 * np.pi * MATCH_BLUR_PX**2)
    for step in (*(-d for d in REACH), *REACH):
        if (i, i + step) in flow:
            there, inside = look_up(grey[i + step], flow[i, i + step])
            difference = there - grey[i]
            difference -= np.median(difference[::2, ::2])
            unlike = cv2.GaussianBlur(difference, (0, 0), MATCH_BLUR_PX) ** 2 / limit
            weight = np.exp(-unlike / 2) * inside
            total += weight * (grey[i] + difference)
            weights += weight
            squares += weight**2
    return np.rint(np.clip(total / weights, 0, 255)).astype(np.uint8), noise * squares / weights**2


def averaged_variance(image: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """`flow_variance` [h, w] px^2 of an averaged frame [h, w] uint8 with noise variance [h, w], as an upper estimate.

    It takes into account that averaged frames share noise (SHARED), and that their flow needs texture in a wider window
    (SUPPORT_PX).
    """
    variance = flow_variance(image, noise)
    around = cv2.blur(np.minimum(variance, NO_TEXTURE), (SUPPORT_PX, SUPPORT_PX))
    return np.asarray(SHARED * np.maximum(variance, around))
