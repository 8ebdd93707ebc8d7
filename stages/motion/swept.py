"""Static depths that the pictures tell where flow is lost: of thin things close to a camera that travels.

The flow of a bar that is thinner than its way from frame to frame is that of what is behind it, or none, and so is its
depth. Neither fits the pictures: it looks like something that moves. Its own depth does (`shared.depth_sweep`).
"""

import numpy as np

from stages.shared.depth_sweep import Other, least_difference, reach, worse_side

FRAMES = 2
"""Largest distance in frames between compared pictures."""
SHARE = 0.5
"""Of the flow's difference above the median of the frame, what a static depth may leave, at most."""


def explained(others: list[Other], suspect: np.ndarray, static: np.ndarray) -> np.ndarray:
    """Where [h, w] bool, of `suspect` [h, w], some static depth matches the pictures far better than the flow does.

    Both are compared with the same frames, and the worse of the earlier and the later ones counts, if both show it: a
    thing that moves may lie where a static one would, in two frames by chance. In all frames it does so if it is lost
    to the flow and moves evenly against the camera's motion: like something near, no picture tells it apart. What
    matches as well as half of the frame does is explained in any case.

    Args:
        others: frames at most FRAMES away. static: [n] inverse depths of pixels that flow knows to be static.
    """
    if not others or not suspect.any() or not len(static):
        return np.zeros_like(suspect)
    by_flow = worse_side(others)
    floor = np.median(by_flow)
    least = least_difference(others, suspect, reach(others, static, suspect.shape))
    return np.asarray(least < floor + SHARE * np.maximum(by_flow - floor, 0))
