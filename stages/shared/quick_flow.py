"""Flow by OpenCV's presets of dense inverse search, for looks at reduced frames; the stage `flow` has its own."""

import cv2
import numpy as np

LEAST_PX = 32
"""Of either side: the presets search patches of 8 px at a quarter of the size and coarser, and crash on less."""


def quick_flow(source: np.ndarray, target: np.ndarray, preset: int, start: np.ndarray | None = None) -> np.ndarray:
    """Flow [h, w, 2] px from one frame [h, w] uint8 to another, of any size: its last row and column continue it.

    Args:
        preset: one of cv2.DISOPTICAL_FLOW_PRESET_*. start: [h, w, 2] from which it is searched; None: from rest.
    """
    h, w = source.shape
    missing = (0, max(0, LEAST_PX - h)), (0, max(0, LEAST_PX - w))
    before, after = (np.pad(image, missing, "edge") for image in (source, target))
    begun = None if start is None else np.pad(start, (*missing, (0, 0)), "edge")
    return np.asarray(cv2.DISOpticalFlow.create(preset).calc(before, after, begun)[:h, :w])
