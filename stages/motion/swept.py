"""Static depths that the pictures tell where flow is lost: of thin things close to a camera that travels.

The flow of a bar that is thinner than its way from frame to frame is that of what is behind it, or none, and so is its
depth. Neither fits the pictures: it looks like something that moves. Its own depth does (`depth_sweep`). Along a
rail or a post that is wider all flow fits the pictures, since its edges run one way, and the one found is that of what
is around; its own depth fits them as well.
"""

import cv2
import numpy as np

from stages.motion.depth_sweep import Other, least_difference, reach, worse_side

FRAMES = 2
"""Largest distance in frames between compared pictures."""
SHARE, SHARE_ALONG = 0.5, 1.0
"""Of the flow's difference above the median of the frame, what a static depth may leave, at most; where edges run one
way, all of it."""
ACROSS, EDGES_PX = 0.1, 3.0
"""Edges run one way where the brightness varies along them by less than this share of how it varies across, as mean
squares over a Gaussian of this standard deviation."""


def run_one_way(frame: np.ndarray) -> np.ndarray:
    """Where [h, w] bool the edges in a frame [h, w, 3] uint8 run one way, and tell no flow along them.

    By the eigenvalues of the structure tensor (Bigun and Granlund, ICCV 1987).
    """
    grey = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
    x, y = (cv2.Sobel(grey, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
    xx, xy, yy = (cv2.GaussianBlur(product, (0, 0), EDGES_PX) for product in (x * x, x * y, y * y))
    middle, apart = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    return np.asarray(middle - apart < ACROSS * (middle + apart))


def explained(others: list[Other], suspect: np.ndarray, static: np.ndarray, one_way: np.ndarray) -> np.ndarray:
    """Where [h, w] bool, of `suspect` [h, w], some static depth matches the pictures far better than the flow does, or,
    where edges run `one_way` [h, w], as well.

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
    share = np.where(one_way, SHARE_ALONG, SHARE)
    return np.asarray(least < floor + share * np.maximum(by_flow - floor, 0))
