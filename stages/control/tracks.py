"""Tracks of dynamic pixels through the training frames, from flow.

Held-out frames are not used: a track crosses them with the longer flow edge between the neighbouring training frames.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from stages.shared.warp import bilinear

DISAGREEMENT_PX, DISAGREEMENT_PER_PX = 1.0, 0.05
"""A track ends where forward and backward flow differ by more than this: a floor plus a share of the motion. Flow
confidence is too strict here: it keeps the few pixels that poses need, and only half to a sixth of a mover's."""
MIN_FRAMES = 3
"""A track seen in fewer training frames hardly separates motion from noise; it is used only where no other passes."""


@dataclass(frozen=True)
class Links:
    """Flow between neighbouring training frames; F frames, flow grid [h, w].

    Attributes:
        frames: [F] 0-based indices of the training frames.
        flow: [2, F - 1, h, w, 2] float32 in grid pixels: [0, k] from frame k to k + 1, [1, k] back from k + 1 to k.
        known: [F - 1] whether the edge list has both edges of the step; if not, its flow is zero.
        missing: missing edges, as (source, target) frame indices.
    """

    frames: np.ndarray
    flow: np.ndarray
    known: np.ndarray
    missing: list[tuple[int, int]]


@dataclass(frozen=True)
class Tracks:
    """n tracks over the F training frames.

    Attributes:
        uv: [n, F, 2] float32 in pixels of the flow grid; undefined where not visible.
        visible: [n, F].
    """

    uv: np.ndarray
    visible: np.ndarray


def training_links(source: np.ndarray, target: np.ndarray, flow: np.ndarray, is_training: np.ndarray) -> Links:
    """Pick the edges between neighbouring training frames out of the edge list [E] with flow [E, h, w, 2].

    Args:
        is_training: [T], false for held-out frames; no edge that touches one is read.
    """
    frames = np.flatnonzero(is_training)
    rows = {(int(i), int(j)): row for row, (i, j) in enumerate(zip(source, target, strict=True))}
    steps = list(zip(frames[:-1].tolist(), frames[1:].tolist(), strict=True))
    h, w = flow.shape[1:3]
    picked = np.zeros((2, len(steps), h, w, 2), np.float32)
    known = np.ones(len(steps), bool)
    missing = []
    for k, (i, j) in enumerate(steps):
        for way, edge in enumerate(((i, j), (j, i))):
            if edge in rows:
                picked[way, k] = flow[rows[edge]]
            else:
                known[k] = False
                missing.append(edge)
    return Links(frames, picked, known, missing)


def track_dynamic_pixels(links: Links, masks: np.ndarray, stride_px: int) -> Tracks:
    """Track dynamic pixels forward and backward in time until they leave mask or image, or fail the backward check.

    Seeds lie on a grid in every training frame, from the middle frame outwards, where no earlier track passes, so that
    parts that appear late get tracks as well.

    Args:
        masks: [F, h, w] dynamic masks of the training frames on the flow grid.
        stride_px: grid step of the seeds in pixels of the flow grid.
    """
    F = len(masks)
    kernel = np.ones((3, 3), np.uint8)  # pixels on the outline mix two motions
    inner = np.stack([cv2.erode(mask.astype(np.uint8), kernel) > 0 for mask in masks])
    uv, visible = [np.zeros((0, F, 2), np.float32)], [np.zeros((0, F), bool)]
    for k in sorted(range(F), key=lambda k: abs(k - F // 2)):
        covered = _covered(uv, visible, k, inner.shape[1:], stride_px)
        v, u = np.nonzero(inner[k] & ~covered)
        on_grid = (u % stride_px == 0) & (v % stride_px == 0)
        if on_grid.any():
            seeds = np.stack([u, v], axis=-1)[on_grid].astype(np.float32)
            new_uv, new_visible = _follow(links, inner, seeds, k)
            uv.append(new_uv)
            visible.append(new_visible)
    tracks = Tracks(np.concatenate(uv), np.concatenate(visible))
    kept = _worth_keeping(tracks, inner.shape[1:], stride_px)
    return Tracks(tracks.uv[kept], tracks.visible[kept])


def _worth_keeping(tracks: Tracks, shape: tuple[int, ...], stride_px: int) -> np.ndarray:
    """Which tracks [n] to fit: the long ones, and tracks of two frames where no long one passes."""
    sightings = tracks.visible.sum(axis=1)
    kept = np.asarray(sightings >= min(MIN_FRAMES, tracks.visible.shape[1]))
    long_uv, long_visible = tracks.uv[kept], tracks.visible[kept]
    for k in range(tracks.visible.shape[1]):
        short = np.flatnonzero(tracks.visible[:, k] & (sightings == MIN_FRAMES - 1))
        u, v = np.rint(tracks.uv[short, k]).astype(int).T
        kept[short[~_covered([long_uv], [long_visible], k, shape, stride_px)[v, u]]] = True
    return kept


def _covered(
    uv: list[np.ndarray], visible: list[np.ndarray], k: int, shape: tuple[int, ...], stride_px: int
) -> np.ndarray:
    """Pixels [h, w] of training frame k within one grid step of a track."""
    image = np.zeros(shape, np.uint8)
    for some_uv, some_visible in zip(uv, visible, strict=True):
        u, v = np.rint(some_uv[some_visible[:, k], k]).astype(int).T
        image[v, u] = 1
    size = 2 * stride_px + 1
    return cv2.dilate(image, np.ones((size, size), np.uint8)) > 0


def _follow(links: Links, inner: np.ndarray, seeds: np.ndarray, start: int) -> tuple[np.ndarray, np.ndarray]:
    """Tracks through all training frames of seeds [n, 2] in frame `start`: uv [n, F, 2], visible [n, F]."""
    F, h, w = inner.shape
    uv, visible = np.zeros((len(seeds), F, 2), np.float32), np.zeros((len(seeds), F), bool)
    uv[:, start], visible[:, start] = seeds, True
    for way, targets in enumerate((range(start + 1, F), range(start - 1, -1, -1))):
        for k in targets:
            before, step = (k - 1, k - 1) if way == 0 else (k + 1, k)
            here = uv[:, before]
            motion = bilinear(links.flow[way, step], here)
            there = here + motion
            inside = (there >= 0).all(axis=1) & (there[:, 0] <= w - 1) & (there[:, 1] <= h - 1)
            alive = visible[:, before] & links.known[step] & inside
            alive &= _agree(motion, bilinear(links.flow[1 - way, step], there))
            u, v = np.rint(np.where(alive[:, None], there, 0)).astype(int).T
            visible[:, k] = alive & inner[k, v, u]
            uv[:, k] = np.where(visible[:, k, None], there, 0)
    return uv, visible


def _agree(motion: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Whether forward flow [n, 2] px and the backward flow at its target [n, 2] nearly cancel, [n] bool."""
    disagreement = np.linalg.norm(motion + back, axis=1)
    return np.asarray(disagreement < DISAGREEMENT_PX + DISAGREEMENT_PER_PX * np.linalg.norm(motion, axis=1))
