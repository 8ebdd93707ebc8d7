"""Sampling images along optical flow and at pixels. Flow [h, w, 2] is (u, v) in pixels, pixel centres at integers."""

import cv2
import numpy as np

Part = tuple[slice, slice]
"""Rows and columns of an image, with or without steps."""
REMAP_ROWS = 30_000
"""OpenCV's remap takes fewer than 32768 rows."""


def matches(flow: np.ndarray, every: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Pixel coordinates u and v [h, w] float32 to which flow [h, w, 2] leads; [::every, ::every] of them."""
    h, w = flow.shape[:2]
    flow = flow[::every, ::every].astype(np.float32, copy=False)
    columns, rows = np.arange(0, w, every, dtype=np.float32), np.arange(0, h, every, dtype=np.float32)
    return flow[..., 0] + columns, flow[..., 1] + rows[:, None]


def warp(image: np.ndarray, flow: np.ndarray, every: int = 1) -> np.ndarray:
    """The target's image [h, w] or [h, w, c] sampled along flow [h, w, 2] from the source.

    Sampling is bilinear; outside the image the border is repeated. The result is [::every, ::every] of the whole.
    """
    return _sampled(image, *matches(flow, every))


def look_up(image: np.ndarray, flow: np.ndarray, part: Part = np.s_[:, :]) -> tuple[np.ndarray, np.ndarray]:
    """`warp` and `is_inside` of a part of the source, at once: both need the same coordinates."""
    h, w = flow.shape[:2]
    u, v = (of[part] for of in matches(flow))
    return _sampled(image, u, v), _inside(u, v, h, w)


def _sampled(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def bilinear(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear values [...] or [..., C] of an image [h, w] or [h, w, C] at pixels uv [..., 2].

    Outside the image the border is repeated. OpenCV rounds the coordinates to 1/32 px. The result is float64 for a
    float64 image, otherwise float32.
    """
    source = image if image.dtype == np.float64 else image.astype(np.float32, copy=False)
    if uv.size == 0:
        return np.zeros((*uv.shape[:-1], *image.shape[2:]), source.dtype)
    columns = uv.shape[-2] if uv.ndim > 2 else 1
    u, v = np.moveaxis(uv.reshape(-1, columns, 2).astype(np.float32, copy=False), -1, 0)
    blocks = [slice(start, start + REMAP_ROWS) for start in range(0, len(u), REMAP_ROWS)]
    sampled = [
        cv2.remap(source, np.ascontiguousarray(u[b]), np.ascontiguousarray(v[b]), cv2.INTER_LINEAR,
                  borderMode=cv2.BORDER_REPLICATE)
        for b in blocks
    ]  # fmt: skip
    return np.concatenate(sampled).reshape(*uv.shape[:-1], *image.shape[2:])


def is_inside(flow: np.ndarray) -> np.ndarray:
    """Whether flow [h, w, 2] ends inside the target's image, [h, w] bool."""
    h, w = flow.shape[:2]
    return _inside(*matches(flow), h, w)


def _inside(u: np.ndarray, v: np.ndarray, h: int, w: int) -> np.ndarray:
    return np.asarray((u >= 0) & (u <= w - 1) & (v >= 0) & (v <= h - 1))
