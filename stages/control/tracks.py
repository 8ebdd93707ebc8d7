"""Tracks of dynamic pixels through the training frames, from flow.

Held-out frames are not used: a track crosses them with the longer flow edge between the neighbouring training frames.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np

from stages.shared.log import progress
from stages.shared.warp import bilinear

DISAGREEMENT_PX, DISAGREEMENT_PER_PX = 1.0, 0.05
"""A track ends where forward and backward flow differ by more than this: a floor plus a share of the motion. Flow
confidence is too strict here: it keeps the few pixels that poses need, and only half to a sixth of a mover's."""
HELD_BYTES = 250_000_000
"""Memory for flow that tracks have followed; two edges at least."""
MIN_FRAMES = 3
"""A track seen in fewer training frames hardly separates motion from noise; it is used only where no other passes."""


@dataclass(frozen=True)
class Links:
    """Flow between neighbouring training frames; F frames, flow grid [h, w].

    Attributes:
        frames: [F] 0-based indices of the training frames.
        rows: [2, F - 1] where their flow is: [0, k] from frame k to k + 1, [1, k] back from k + 1 to k.
        flow: [E, h, w, 2] in grid pixels, mapped from its file. release: gives back what was read of it.
        known: [F - 1] whether the edge list has both edges of the step.
        missing: missing edges, as (source, target) frame indices.
    """

    frames: np.ndarray
    rows: np.ndarray
    flow: np.ndarray
    known: np.ndarray
    missing: list[tuple[int, int]]
    release: Callable[[], None]

    @cached_property
    def _edge(self) -> Callable[[int], np.ndarray]:
        """The flow of an edge; those used last are kept, as tracks of neighbouring frames pass the same ones."""
        of_edge = int(np.prod(self.flow.shape[1:])) * self.flow.dtype.itemsize
        most = max(HELD_BYTES // max(of_edge, 1), 2)
        return lru_cache(most)(lambda row: np.asarray(self.flow[row]))

    def motion(self, way: int, step: int, uv: np.ndarray) -> np.ndarray:
        """Flow [n, 2] of a step at pixels uv [n, 2] of the frame that it leaves."""
        field = self._edge(int(self.rows[way, step]))
        low = np.maximum(np.floor(uv.min(axis=0)).astype(int) - 1, 0)
        high = np.maximum(np.ceil(uv.max(axis=0)).astype(int) + 2, low + 1)
        low = np.minimum(low, np.array(field.shape[1::-1]) - 1)
        part = field[low[1] : high[1], low[0] : high[0]].astype(np.float32)
        return bilinear(part, uv - low.astype(np.float32))


@dataclass(frozen=True)
class Tracks:
    """n tracks over F training frames, as the M sightings of all of them, by track and then by frame.

    Attributes:
        n, F: numbers of tracks and frames. track, frame: [M] of each sighting.
        uv: [M, 2] float32 in pixels of the flow grid.
    """

    n: int
    F: int
    track: np.ndarray
    frame: np.ndarray
    uv: np.ndarray

    @cached_property
    def lengths(self) -> np.ndarray:
        """Number of sightings [n] of each track."""
        return np.bincount(self.track, minlength=self.n)

    def only(self, kept: np.ndarray) -> "Tracks":
        """The tracks that are kept, [n] bool, numbered anew."""
        rows = kept[self.track]
        return Tracks(int(kept.sum()), self.F, (np.cumsum(kept) - 1)[self.track[rows]], self.frame[rows], self.uv[rows])


def training_links(
    source: np.ndarray,
    target: np.ndarray,
    flow: np.ndarray,
    is_training: np.ndarray,
    release: Callable[[], None] = lambda: None,
) -> Links:
    """Pick the edges between neighbouring training frames out of the edge list [E] with flow [E, h, w, 2].

    Args:
        is_training: [T], false for held-out frames; no edge that touches one is read.
        release: gives back what was read of the flow.
    """
    frames = np.flatnonzero(is_training)
    rows = {(int(i), int(j)): row for row, (i, j) in enumerate(zip(source, target, strict=True))}
    steps = list(zip(frames[:-1].tolist(), frames[1:].tolist(), strict=True))
    ways = [steps, [(j, i) for i, j in steps]]
    picked = np.array([[rows.get(edge, -1) for edge in way] for way in ways])
    missing = [edge for both in zip(*ways, strict=True) for edge in both if edge not in rows]
    return Links(frames, picked, flow, np.asarray((picked >= 0).all(axis=0)), missing, release)


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
    passed, n = np.zeros(inner.shape, bool), 0
    found = [(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2), np.float32))]
    for k in progress(sorted(range(F), key=lambda k: abs(k - F // 2)), "tracks"):
        v, u = np.nonzero(inner[k] & ~_covered(passed[k], stride_px))
        on_grid = (u % stride_px == 0) & (v % stride_px == 0)
        if on_grid.any():
            seeds = np.stack([u, v], axis=-1)[on_grid].astype(np.float32)
            track, frame, uv = _follow(links, inner, seeds, k)
            at_u, at_v = np.rint(uv).astype(int).T
            passed[frame, at_v, at_u] = True
            found.append((n + track, frame, uv))
            n += len(seeds)
            links.release()
    tracks = Tracks(n, F, *(np.concatenate(part) for part in zip(*found, strict=True)))
    return tracks.only(_worth_keeping(tracks, inner.shape[1:], stride_px))


def _worth_keeping(tracks: Tracks, shape: tuple[int, ...], stride_px: int) -> np.ndarray:
    """Which tracks [n] to fit: the long ones, and tracks of two frames where no long one passes."""
    lengths = tracks.lengths
    kept = np.asarray(lengths >= min(MIN_FRAMES, tracks.F))
    is_long, is_short = kept[tracks.track], lengths[tracks.track] == MIN_FRAMES - 1
    u, v = np.rint(tracks.uv).astype(int).T
    for rows in sightings_by_frame(tracks):
        short, passed = rows[is_short[rows]], np.zeros(shape, bool)
        if len(short):
            passed[v[rows[is_long[rows]]], u[rows[is_long[rows]]]] = True
            kept[tracks.track[short[~_covered(passed, stride_px)[v[short], u[short]]]]] = True
    return kept


def sightings_by_frame(tracks: Tracks) -> list[np.ndarray]:
    """The sightings of each frame, as indices."""
    order = np.argsort(tracks.frame, kind="stable")
    return np.split(order, np.searchsorted(tracks.frame[order], np.arange(1, tracks.F)))


def _covered(passed: np.ndarray, stride_px: int) -> np.ndarray:
    """Pixels [h, w] of a frame within one grid step of those that tracks pass, [h, w] bool."""
    size = 2 * stride_px + 1
    return cv2.dilate(passed.astype(np.uint8), np.ones((size, size), np.uint8)) > 0


def _follow(
    links: Links, inner: np.ndarray, seeds: np.ndarray, start: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sightings of the tracks of seeds [n, 2] in frame `start`: track [m], frame [m] and uv [m, 2] float32."""
    F, h, w = inner.shape
    found = [(np.arange(len(seeds)), np.full(len(seeds), start), seeds)]
    for way, targets in enumerate((range(start + 1, F), range(start - 1, -1, -1))):
        track, here = np.arange(len(seeds)), seeds
        for k in targets:
            step = k - 1 if way == 0 else k
            if not len(track) or not links.known[step]:
                break
            motion = links.motion(way, step, here)
            there = here + motion
            alive = (there >= 0).all(axis=1) & (there[:, 0] <= w - 1) & (there[:, 1] <= h - 1)
            alive &= _agree(motion, links.motion(1 - way, step, there))
            u, v = np.rint(np.where(alive[:, None], there, 0)).astype(int).T
            alive &= inner[k, v, u]
            track, here = track[alive], there[alive]
            found.append((track, np.full(len(track), k), here))
    track, frame, uv = (np.concatenate(part) for part in zip(*found, strict=True))
    order = np.lexsort((frame, track))
    return track[order], frame[order], uv[order]


def _agree(motion: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Whether forward flow [n, 2] px and the backward flow at its target [n, 2] nearly cancel, [n] bool."""
    disagreement = np.linalg.norm(motion + back, axis=1)
    return np.asarray(disagreement < DISAGREEMENT_PX + DISAGREEMENT_PER_PX * np.linalg.norm(motion, axis=1))
