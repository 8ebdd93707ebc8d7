"""Compiled loops over the pixels of flow."""

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, error_model="numpy")
def weigh(flow, weights, least):  # type: ignore[no-untyped-def]
    """Raise weights [h, w] of flow [h, w, 2] px to `least` times the share above 0.5; 0 where it leaves the frame."""
    h, w = weights.shape
    confident = 0
    for y in range(h):
        for x in range(w):
            confident += weights[y, x] > 0.5
    floor = np.float32(least * confident / (h * w))
    for y in range(h):
        for x in range(w):
            u, v = x + flow[y, x, 0], y + flow[y, x, 1]
            inside = u >= 0 and u <= w - 1 and v >= 0 and v <= h - 1
            weights[y, x] = max(weights[y, x], floor) if inside else np.float32(0)
