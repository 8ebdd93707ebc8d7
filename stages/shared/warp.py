"""Looking images up along optical flow. Flow [h, w, 2] is (u, v) in pixels, pixel centres at integers."""

import cv2
import numpy as np


def matches(flow: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows [h, w] float32 that flow [h, w, 2] leads to."""
    h, w = flow.shape[:2]
    flow = flow.astype(np.float32, copy=False)
    return flow[..., 0] + np.arange(w, dtype=np.float32), flow[..., 1] + np.arange(h, dtype=np.float32)[:, None]


def warp(image: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """The target's image [h, w] or [h, w, c] as the source sees it: bilinear, the border repeated outside."""
    u, v = matches(flow)
    return np.asarray(cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def is_inside(flow: np.ndarray) -> np.ndarray:
    """Whether flow [h, w, 2] leads to a place inside the target's image, [h, w] bool."""
    h, w = flow.shape[:2]
    u, v = matches(flow)
    return np.asarray((u >= 0) & (u <= w - 1) & (v >= 0) & (v <= h - 1))
