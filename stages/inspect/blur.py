"""Blurred frames: those with less fine detail than the frames around them."""

from collections.abc import Sequence

import cv2
import numpy as np

from stages.shared.images import reduce, reduced_size

SIDE_PX = 512
"""Longer side at which detail is measured: about that of the flow, which finer blur does not harm."""
NEIGHBOURS = 4
LEAST_DETAIL = 0.7
"""A frame is blurred if it has less than this share of the detail of its neighbours.

Of 1080 frames of 40 clips the least share was 0.88; of one frame of each, with a motion blur of 9 px, it was 0.44 in
the median and less than 0.64 for 95 in 100.
"""


def detail(image: np.ndarray) -> float:
    """Mean absolute Laplacian of the brightness of a frame [H, W, 3] uint8, grey levels per px^2."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    small = reduce(grey, reduced_size(grey.shape[1], grey.shape[0], SIDE_PX))
    return float(np.abs(cv2.Laplacian(small, cv2.CV_32F)).mean())


def blurred(details: Sequence[float]) -> list[int]:
    """Indices of the blurred frames, by the `detail` of all.

    A frame is compared with the median before and with that after it, and has to have less than both: at a cut the
    detail changes for good.
    """
    values = np.asarray(details)
    found = []
    for k in range(len(values)):
        sides = (values[max(0, k - NEIGHBOURS) : k], values[k + 1 : k + 1 + NEIGHBOURS])
        if values[k] < LEAST_DETAIL * min(np.median(side) for side in sides if len(side)):
            found.append(k)
    return found
