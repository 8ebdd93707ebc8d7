"""Test of a surface at rest under light that changes: shadows of movers pass over it.

Flow follows the edge of a shadow, and the ground in it seems to move. But the ground's own texture stays where the
static scene has it, multiplied by a gain: between two frames aligned by that scene the logarithm of the brightness
differs by steps and ramps alone, which a median filter keeps. What the filter takes away, the detail, is zero there. On
a mover it is the texture of both frames, which its flow aligns. Noise has detail too, so it confirms nothing.
"""

import cv2
import numpy as np

from stages.motion.pooling import spread
from stages.shared.static_flow import dense_static_flow
from stages.shared.warp import bilinear, look_up

DARKEST = 4.0
"""Colour levels added before the logarithm."""
DETAIL_PX, NEAR_PX = 5, 3
"""Window of the median that leaves no detail, and of means."""
FAINT = 0.005
"""Detail of the logarithm of brightness at which a pixel counts half."""
ALIKE = 0.2
"""Detail of the difference, as a share of that of both frames, at which they are half alike."""
TELLING_PX = 2.0
"""Distance of the two ways at which a comparison of them counts half."""
UNKNOWN = 0.1
"""Weight, in pixels of full weight, of the assumption that nothing is alike."""
LEAST, RANGE = 0.3, 0.2
"""Share of the texture that is alike where a surface is half taken to be at rest, and the range from not at all to
fully. The share along the flow counts as the first where it is larger."""
TINY = 1e-9


def log_detail(rgb: np.ndarray) -> np.ndarray:
    """Logarithm of the brightness and its detail, [h, w, 2] float32, of a frame [h, w, 3] uint8."""
    grey = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 0.7)
    brightness = np.log(grey + DARKEST)
    return np.dstack([brightness, brightness - cv2.medianBlur(brightness, DETAIL_PX)])


def patches(detail: np.ndarray, uv: np.ndarray, size_px: int) -> np.ndarray:
    """Detail [n, size_px^2], of [h, w], of the squares around pixels uv [n, 2]."""
    reach = np.arange(size_px) - size_px // 2
    offsets = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    return bilinear(detail, uv[:, None] + offsets)


def at_rest(
    details: dict[int, np.ndarray],
    i: int,
    rgb: np.ndarray,
    targets: np.ndarray,
    flows: np.ndarray,
    projections: tuple[np.ndarray, np.ndarray],
    inverse_depth: np.ndarray,
) -> np.ndarray:
    """How clearly [h, w], 0..1, the texture of frame i stays where the static scene has it and not where flow leads.

    0 where both lead to the same place, where there is no texture, and where flow explains more of it. As in
    `photometric`, the better of earlier and later frames counts.

    Args:
        details: `log_detail` per frame. rgb: frame i, [h, w, 3] uint8.
        targets: [E]; flows: [E, h, w, 2] px; projections: A [E, 3, 3] and b [E, 3], or those of every row, of edges
            that leave frame i.
        inverse_depth: [h, w] of the static scene.
    """
    here = details[i]
    alike, counted = np.zeros((2, 2, 2, *here.shape[:2]), np.float32)
    for j, flow, A, b in zip(targets, flows, *projections, strict=True):
        ways = dense_static_flow(A, b, inverse_depth), flow.astype(np.float32, copy=False)
        squared = sum(apart**2 for apart in np.moveaxis(ways[0] - ways[1], -1, 0))
        shown = [look_up(details[int(j)], way) for way in ways]
        telling = squared / (squared + TELLING_PX**2) * (shown[0][1] & shown[1][1])
        for k, (there, _) in enumerate(shown):
            weight, share = compared(here, there)
            counted[int(j > i), k] += telling * weight
            alike[int(j > i), k] += telling * weight * share
    static, along_flow = (_best_share(alike[:, k], counted[:, k], rgb) for k in range(2))
    return np.asarray(np.clip((static - np.maximum(along_flow, LEAST)) / RANGE + 0.5, 0, 1))


def compared(here: np.ndarray, there: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weight [h, w] of the texture of two aligned `log_detail`, and how alike [h, w] it is, both 0..1."""
    difference = here[..., 0] - there[..., 0]
    detail = np.abs(difference - cv2.medianBlur(difference, DETAIL_PX))
    misfit, texture = (
        cv2.blur(values, (NEAR_PX, NEAR_PX)) for values in (detail, np.abs(here[..., 1]) + np.abs(there[..., 1]))
    )
    squared = (misfit / (ALIKE * texture + 1e-4)) ** 2
    return texture**2 / (texture**2 + FAINT**2), 1 / (1 + squared**2)


def _best_share(alike: np.ndarray, counted: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """Share [h, w] of the texture that is alike on the better of two sides [2, h, w], pooled up to colour edges."""
    alike, counted = (np.stack([cv2.blur(of_side, (NEAR_PX, NEAR_PX)) for of_side in x]) for x in (alike, counted))
    better = np.argmax(alike / (counted + UNKNOWN), axis=0)[None]
    alike, counted = (np.take_along_axis(x, better, axis=0)[0] for x in (alike, counted))
    alike, counted = spread(alike / np.maximum(counted, TINY), counted, rgb)
    return np.asarray(alike / (counted + UNKNOWN))
