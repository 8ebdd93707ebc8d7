"""What is burnt into the frames and no part of the scene: logos, time codes, black bars.

A burnt-in edge keeps its place in the image while the scene around it moves. Edges persist where their gradient has
one direction in all frames (after Dekel et al., CVPR 2017, who find watermarks by the median gradient of a collection).
That is evidence only where the motion of the surroundings would have changed the edge: not along a rail in a pan, and
not at all before a camera at rest, of which nothing can be known. An object that the camera follows persists as well,
but never to a fraction of a pixel.
"""

import itertools
from typing import NamedTuple

import cv2
import numpy as np

from stages.shared.bars import BrightestYet
from stages.shared.images import enlarge, reduce, reduced_size
from stages.shared.quick_flow import quick_flow
from stages.shared.warp import warp

SIDE_PX = 512
FLOW_SIDE_PX = 256
STEP_PX = 2.0
"""Motion of the image from one compared frame to the next, at FLOW_SIDE_PX: as long as an edge is wide."""
REST_PX = 0.2
"""Median motion between frames that counts as none, at FLOW_SIDE_PX: DIS finds less than this in noise."""
COMPARED = 32
"""At most so many frames are compared, spread over the clip; and at least MIN_COMPARED."""
MIN_COMPARED = 6
EDGE = 5.0
"""Least gradient of an edge, grey levels per px."""
FAINT = 2.0
"""The same of an edge that does not stand in every frame, as those of running digits."""
STAYS = 0.9
"""An edge persists if so many of the frames show at least WEAKEST of its median gradient, in its direction."""
WEAKEST = 0.4
SIGNIFICANT = 3.0
"""A faint edge persists if the sum of its gradients is so many times that of gradients in random directions."""
INFORMATIVE = 0.5
"""Share of the compared pairs in which the motion of the surroundings would have changed the edge."""
WINDOW_PX = 11
DENSE = 0.5
"""Within a window, so much of all gradients is that of persistent edges; textures leave persistent ones at random."""
FILLED = 0.08
"""Least share of persistent pixels within a window."""
AROUND_PX = 61
"""Window of the motion of the surroundings, at FLOW_SIDE_PX; CORRUPTED_PX about a persistent edge do not count."""
CORRUPTED_PX = 9
PIXELS = 40
"""Least number of certain edge pixels of a logo: those of text 5 px high."""
WANDER_PX = 0.6
"""Largest motion of what is burnt in, in the mean over the frames and from the first to the last.

Painted on tuned scenes, logos wandered by at most 0.3 px, and by 0.5 px if half transparent (one of nine by 1.1 px:
it is missed); followed figures and chance finds of these scenes by 1 px and more in one of the two.
"""
LARGEST = 0.15
"""With more than this share of the frame persistent, the camera rests, or follows what fills the frame."""
BESIDE_PX = 24
"""Dense persistent edges so near to what is burnt in belong to it: what is left of a box about running digits."""


class Found(NamedTuple):
    """What is burnt in.

    Attributes:
        mask: [H, W] bool. bars_px: thickness of black bars: ((left, right), (above, below)).
        known: false if too little moves, or too much stays as it is, to find anything but bars.
    """

    mask: np.ndarray
    bars_px: tuple[tuple[int, int], tuple[int, int]]
    known: bool


class Watch:
    """The frames to compare, taken from all frames as they are decoded."""

    def __init__(self) -> None:
        self.brightest, self.frames, self.shape = BrightestYet(), list[np.ndarray](), (0, 0)
        self.before: np.ndarray | None = None
        self.moved_px, self.step_px = 0.0, STEP_PX

    def see(self, rgb: np.ndarray) -> None:
        """Take in the next frame [H, W, 3] uint8."""
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        self.brightest.see(grey)
        self.shape = grey.shape
        grey = reduce(grey, reduced_size(grey.shape[1], grey.shape[0], SIDE_PX))
        small = _small(grey)
        if self.before is not None:
            motion_px = float(np.median(np.linalg.norm(_flow(self.before, small), axis=-1)))
            self.moved_px += motion_px if motion_px > REST_PX else 0.0
        self.before = small
        if not self.frames or self.moved_px >= self.step_px:
            self.frames.append(grey)
            self.moved_px = 0.0
        if len(self.frames) > 2 * COMPARED:
            self.frames, self.step_px = self.frames[::2], 2 * self.step_px

    def found(self) -> Found:
        """What is burnt into the frames seen."""
        bars_px = self.brightest.ends_px()
        (left, right), (above, below) = bars_px
        height, width = self.shape
        mask = np.ones(self.shape, bool)
        mask[above : height - below, left : width - right] = False
        if len(self.frames) < MIN_COMPARED:
            return Found(mask, bars_px, False)
        chosen = np.linspace(0, len(self.frames) - 1, min(len(self.frames), COMPARED)).round().astype(int)
        marked = find_overlays(np.stack([self.frames[k] for k in chosen]))
        if marked is None:
            return Found(mask, bars_px, False)
        return Found(mask | (enlarge(marked.astype(np.float32), (width, height)) > 0.5), bars_px, True)


class _Edges(NamedTuple):
    """Gradients [K, h, w, 2] of the compared frames, and their median [h, w, 2], grey levels per px.

    persistent, certain: pixels [h, w] bool whose edge persists; those of them that stand in nearly every frame.
    dense: [h, w] bool where most of what is seen persists.
    """

    gradients: np.ndarray
    median: np.ndarray
    persistent: np.ndarray
    certain: np.ndarray
    dense: np.ndarray


def find_overlays(frames: np.ndarray) -> np.ndarray | None:
    """Pixels [h, w] bool of logos and time codes, by frames [K, h, w] uint8 between which the image moves.

    None where more than LARGEST of the frame persists.
    """
    edges = _edges(frames)
    nothing = np.zeros(frames.shape[1:], bool)
    if not edges.certain.any():
        return nothing
    if edges.dense.mean() > LARGEST:
        return None
    certain = edges.certain & (_informative(frames, edges) >= INFORMATIVE)
    count, labels = cv2.connectedComponents(_widened(edges.dense, 3))
    still = [
        label
        for label in range(1, count)
        if np.count_nonzero(certain & (labels == label)) >= PIXELS
        and max(wander_px(frames, edges.persistent & (labels == label))) <= WANDER_PX
    ]
    burnt_in = edges.persistent & np.isin(labels, still)
    near = np.unique(labels[_widened(burnt_in, 2 * BESIDE_PX + 1) > 0])
    burnt_in |= edges.persistent & np.isin(labels, near[near > 0]) if still else nothing
    return _filled(burnt_in)


def wander_px(frames: np.ndarray, pixels: np.ndarray) -> tuple[float, float]:
    """Motion of what `pixels` [h, w] bool show in frames [K, h, w] uint8: RMS, and from the first third to the last.

    One affine motion per frame against the median over time, by least squares (Lucas and Kanade, IJCAI 1981; Shi and
    Tomasi, CVPR 1994): what is far ahead of a camera that drives on does not move, but grows.
    """
    v, u = np.nonzero(pixels)
    values, middle = frames[:, v, u].astype(np.float64), np.median(frames, axis=0)
    changes = values - middle[v, u]
    changes -= changes.mean(axis=1, keepdims=True)  # of exposure
    at = np.stack([np.ones(len(u)), (u - u.mean()) / SIDE_PX, (v - v.mean()) / SIDE_PX], axis=-1)
    slope = gradients(middle)[v, u].astype(np.float64)
    motions = np.linalg.lstsq((slope[:, :, None] * at[:, None, :]).reshape(len(u), 6), changes.T, rcond=None)[0]
    shifts = np.einsum("nb,cbk->knc", at, motions.reshape(2, 3, len(frames)))
    third = len(frames) // 3
    drift = shifts[-third:].mean(axis=0) - shifts[:third].mean(axis=0)
    return rms(shifts), rms(drift)


def rms(vectors: np.ndarray) -> float:
    """Root of the mean squared length of vectors [..., 2]."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=-1))))


def gradients(grey: np.ndarray) -> np.ndarray:
    """Gradient [h, w, 2] of an image [h, w], grey levels per px, smoothed over 0.7 px."""
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 0.7)
    return np.stack([cv2.Sobel(smooth, cv2.CV_32F, *axis, scale=1 / 8) for axis in ((1, 0), (0, 1))], axis=-1)


def _edges(frames: np.ndarray) -> _Edges:
    """Which edges of frames [K, h, w] uint8 persist."""
    stack = np.stack([gradients(frame) for frame in frames])
    median = np.median(stack, axis=0)
    strength = np.linalg.norm(median, axis=-1)
    along = np.einsum("khwc,hwc->khw", stack, median) / np.maximum(strength, 1e-6)
    certain = (strength >= EDGE) & ((along > WEAKEST * strength).mean(axis=0) >= STAYS)
    total = np.linalg.norm(stack, axis=-1)
    summed = np.linalg.norm(stack.sum(axis=0), axis=-1)
    faint = (summed >= FAINT * len(stack)) & (summed >= SIGNIFICANT * np.sqrt((total**2).sum(axis=0) + 1))
    persistent, mean = certain | faint, total.mean(axis=0)
    window = (WINDOW_PX, WINDOW_PX)
    share = cv2.blur(mean * persistent, window) / (cv2.blur(mean, window) + 0.5)
    dense = (share >= DENSE) & (cv2.blur(persistent.astype(np.float32), window) >= FILLED)
    return _Edges(stack, median, persistent, certain, dense)


def _informative(frames: np.ndarray, edges: _Edges) -> np.ndarray:
    """Share [h, w] of the neighbours among frames [K, h, w] whose motion would have changed an edge of the scene."""
    h, w = frames.shape[1:]
    strength = np.linalg.norm(edges.median, axis=-1)
    size = _small(frames[0]).shape[::-1]
    corrupted = _widened(reduce(edges.dense.astype(np.float32), size) > 0, 2 * CORRUPTED_PX + 1)
    free = 1 - corrupted.astype(np.float32)
    window = (AROUND_PX, AROUND_PX)
    weight = cv2.blur(free, window)
    informative = np.zeros((h, w), np.float32)
    for before, after in itertools.pairwise(frames):
        flow = cv2.blur(_flow(_small(before), _small(after)) * free[..., None], window)
        flow = np.where(weight[..., None] > 1e-3, flow / np.maximum(weight, 1e-3)[..., None], 0)
        flow = enlarge(flow.astype(np.float32), (w, h)) * (w / size[0])
        moved = np.linalg.norm(flow, axis=-1) >= 1
        there = np.stack([warp(np.ascontiguousarray(edges.median[..., c]), -flow) for c in (0, 1)], axis=-1)
        informative += moved & (np.linalg.norm(there - edges.median, axis=-1) > INFORMATIVE * strength)
    return informative / (len(frames) - 1)


def _filled(pixels: np.ndarray) -> np.ndarray:
    """Convex hulls [h, w] bool of the edge pixels [h, w] bool that are near each other: digits run between others."""
    count, labels = cv2.connectedComponents(_widened(pixels, BESIDE_PX + 1))
    filled = np.zeros(pixels.shape, np.uint8)
    for label in range(1, count):
        v, u = np.nonzero(pixels & (labels == label))
        cv2.fillConvexPoly(filled, cv2.convexHull(np.stack([u, v], axis=-1).astype(np.int32)), 1)
    return filled > 0


def _widened(pixels: np.ndarray, size_px: int) -> np.ndarray:
    return cv2.dilate(pixels.astype(np.uint8), np.ones((size_px, size_px), np.uint8))


def _small(grey: np.ndarray) -> np.ndarray:
    return reduce(grey, reduced_size(grey.shape[1], grey.shape[0], FLOW_SIDE_PX))


def _flow(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Flow [h, w, 2] px between frames [h, w] uint8."""
    return quick_flow(before, after, cv2.DISOPTICAL_FLOW_PRESET_FAST)
