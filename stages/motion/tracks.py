"""Long tracks of pixels: flow from frame to frame, chained both ways until forward and backward flow disagree.

They differ from the tracks of the control points: these cover the whole frame, held-out frames too, and are bounded in
time, so that a clip of any length is worked on batch by batch.
"""

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np

from stages.shared.flow_pairs import FlowPairs
from stages.shared.log import progress

STRIDE_PX = 4
"""Grid step of the seeds."""
REACH = 24
"""Frames that a track is followed from its seed, each way."""
MIN_FRAMES = 8
"""Of fewer steps, drift is hardly told from noise."""
DISAGREEMENT_PX, DISAGREEMENT_PER_PX = 0.5, 0.05
"""A track ends where forward and backward flow differ by more than this: a floor plus a share of the motion."""


class Tracks(NamedTuple):
    """n tracks as the M sightings of all of them, by track and then by frame, in consecutive frames.

    Attributes:
        first: [n + 1]; the sightings of track k are first[k]..first[k + 1].
        frame: [M]; uv: [M, 2] float64 px.
    """

    first: np.ndarray
    frame: np.ndarray
    uv: np.ndarray

    @property
    def lengths(self) -> np.ndarray:
        """Number of sightings [n] of each track."""
        return np.diff(self.first)

    @property
    def track(self) -> np.ndarray:
        """The track [M] of each sighting."""
        return np.repeat(np.arange(len(self.first) - 1), self.lengths)

    def sum(self, values: np.ndarray, track: np.ndarray) -> np.ndarray:
        """Sums [n] of values [k] that belong to tracks [k]."""
        return np.bincount(track, values, len(self.first) - 1)


def batches(pairs: FlowPairs, T: int) -> Iterator[Tracks]:
    """The tracks of T frames, batch by batch: those that start at the seeds of one frame.

    Seeds lie on a grid where no earlier track passes; frames whose tracks reach both ways come first.
    """
    h, w = pairs.confidence.shape[1:]
    passed = np.zeros((T, h, w), bool)
    size = 2 * STRIDE_PX - 1
    order = sorted(range(T), key=lambda k: (k % (2 * REACH + 1) != REACH, k))
    for k in progress(order, "long tracks"):
        near = cv2.dilate(passed[k].astype(np.uint8), np.ones((size, size), np.uint8)) > 0
        v, u = np.mgrid[STRIDE_PX // 2 : h : STRIDE_PX, STRIDE_PX // 2 : w : STRIDE_PX]
        free = ~near[v, u]
        if free.any():
            tracks = _follow(pairs, np.stack([u[free], v[free]], axis=-1).astype(float), k, T)
            at_u, at_v = np.rint(tracks.uv).astype(int).T
            passed[tracks.frame, at_v, at_u] = True
            kept = _long(tracks)
            if len(kept.frame):
                yield kept
        pairs.columns.release()


def sampled(field: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear values [n, ...] of a field [h, w, ...] at pixels uv [n, 2] inside it; only those are read."""
    u, v = (np.clip(uv[:, c], 0, field.shape[1 - c] - 1) for c in (0, 1))
    left, top = (np.minimum(np.floor(x), n - 2).astype(int) for x, n in ((u, field.shape[1]), (v, field.shape[0])))
    total = np.zeros((len(uv), *field.shape[2:]))
    for down in (0, 1):
        for right in (0, 1):
            weight = (1 - np.abs(u - left - right)) * (1 - np.abs(v - top - down))
            total += weight.reshape(-1, *[1] * (field.ndim - 2)) * field[top + down, left + right]
    return total


def _follow(pairs: FlowPairs, seeds: np.ndarray, start: int, T: int) -> Tracks:
    """The tracks of seeds [n, 2] in frame `start`."""
    h, w = pairs.confidence.shape[1:]
    found = [(np.arange(len(seeds)), np.full(len(seeds), start), seeds)]
    for way in (1, -1):
        track, here = np.arange(len(seeds)), seeds
        for k in range(start + way, int(np.clip(start + way * (REACH + 1), -1, T)), way):
            forth, back = _edge(pairs, k - way, k), _edge(pairs, k, k - way)
            if not len(track) or forth is None or back is None:
                break
            motion = sampled(pairs.flow[forth], here)
            there = here + motion
            alive = (there >= 0).all(axis=1) & (there[:, 0] <= w - 1) & (there[:, 1] <= h - 1)
            disagreement = np.linalg.norm(motion + sampled(pairs.flow[back], there), axis=1)
            alive &= disagreement < DISAGREEMENT_PX + DISAGREEMENT_PER_PX * np.linalg.norm(motion, axis=1)
            track, here = track[alive], there[alive]
            found.append((track, np.full(len(track), k), here))
    track, frame, uv = (np.concatenate(part) for part in zip(*found, strict=True))
    order = np.lexsort((frame, track))
    first = np.concatenate([[0], np.cumsum(np.bincount(track, minlength=len(seeds)))])
    return Tracks(first, frame[order], uv[order])


def _edge(pairs: FlowPairs, i: int, j: int) -> int | None:
    """The row of an edge; None if there is none, or if it is no evidence."""
    row = pairs.edges.get((i, j))
    return None if row is None or (pairs.counts is not None and not pairs.counts[row]) else row


def _long(tracks: Tracks) -> Tracks:
    """The tracks of at least MIN_FRAMES frames."""
    kept = tracks.lengths >= MIN_FRAMES
    sightings = np.repeat(kept, tracks.lengths)
    first = np.concatenate([[0], np.cumsum(tracks.lengths[kept])])
    return Tracks(first, tracks.frame[sightings], tracks.uv[sightings])
