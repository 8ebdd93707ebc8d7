"""Evidence of slow motion that adds up: drift of long tracks against the static scene, confirmed by the pictures.

A step of a track, from y_t to y_t+1, has a residual e_t to the static scene under the cameras. Errors of the flow are
independent from step to step, so those of a chained track add up like a random walk, whose increments e_t are white. A
mover drifts steadily: its increments are smooth. By how much the slow part of e_t exceeds the fast one is therefore
significant however small each step is, and the fast part measures the noise of that very track. Where a mover passes,
its flow leaks onto what is beside it, and a static track drifts for some frames: a sighting counts as far as its track
drifts there.

Errors that are not white have three sources. Flow leaks from one depth to the next: that of a static scene at a depth
in between. Hence each step may have any depth of its surroundings, and an error in proportion to the range of flow that
these span. Cameras are wrong, or expose row by row: most flow of a frame then has a residual in common, and a
track must drift with it and without. Flow follows the edges of shadows, or slides along poles: the pictures tell. The
detail around a track (`shadows.log_detail`) stays with what moves, and with the static scene otherwise.
"""

import numpy as np

from stages.motion.pooling import spread
from stages.motion.static_paths import Projected, StaticScene
from stages.motion.tracks import Tracks, batches
from stages.shared.threads import threaded

PERIOD = 8
"""Steps of a track per cosine that counts as slow."""
FLOOR_PX, PER_PX, PER_SPAN = 0.03, 0.04, 0.12
"""Error of flow that is the same from step to step: a floor, a share of the motion, a share of the range of flow that
the depths around span."""
RELIABLE = 0.5
"""Mean confidence of the flow of a track at which its drift counts fully."""
GAP, EVERY = 10, 3
"""Frames between compared pictures, at most; every third sighting of a track is compared."""
PATCH_PX = 7
AGREES = 0.1, 0.3
"""Share by which the pictures agree better along the track, from which it counts, and from which fully."""
MIN_SIGNIFICANCE = 0.2
"""Tracks of less are not compared."""
AROUND, HERE = 2.0, 0.02
"""Steps around a sighting, a standard deviation, in which its track must drift, and the share of its mean power there
from which on the sighting counts fully: movers pause. With 0.05 the IoU of breathing_wall, orbit_two, crowd_thin and
museum_dolly differs by up to .003, with 0.5 orbit_two and breathing_wall lose .017 and .014."""
TINY = 1e-12
MIN_DENSITY = 1e-4
"""Tracks per pixel, spread up to colour edges, below which there is no evidence."""


def drifting(scene: StaticScene, rgb: np.ndarray) -> np.ndarray:
    """Evidence of motion [T, h, w] in 0..1, on the scale of a pooled residual, from long tracks.

    Args:
        rgb: [T, h, w, 3] uint8 frames on the flow grid.
    """
    T, h, w = rgb.shape[:3]
    frames, cells, values = [np.zeros(0, np.int32)], [np.zeros(0, np.int32)], [np.zeros(0, np.float32)]
    for tracks in batches(scene.pairs, T):
        u, v = np.rint(tracks.uv).astype(np.int32).T
        frames.append(tracks.frame.astype(np.int32))
        cells.append(v * w + u)
        values.append(moving(tracks, scene).astype(np.float32))
    frame, cell, value = (np.concatenate(part) for part in (frames, cells, values))
    order = np.argsort(frame, kind="stable")
    ends = np.searchsorted(frame[order], np.arange(T + 1))

    def of_frame(k: int) -> np.ndarray:
        rows = order[ends[k] : ends[k + 1]]
        density, total = (np.bincount(cell[rows], of, h * w).reshape(h, w) for of in (None, value[rows]))
        summed, seen = spread(total / np.maximum(density, 1), density.astype(np.float32), rgb[k])
        return np.where(seen > MIN_DENSITY, summed / np.maximum(seen, MIN_DENSITY), 0).astype(np.float32)

    evidence = np.empty((T, h, w), np.float32)
    for begin, end in scene.pairs.blocks(T, "drift"):
        evidence[begin:end] = threaded(of_frame, range(begin, end))
    return evidence


def moving(tracks: Tracks, scene: StaticScene) -> np.ndarray:
    """Evidence [M] in 0..1 that what is sighted moves: S^2 / (S^2 + 1) of the significance S of the drift of its track,
    as far as pictures agree, and as far as the track drifts there.
    """
    residuals, allowed_px, reliability = _steps(tracks, scene)
    parts = (slow_and_fast(tracks, of) for of in residuals)
    significance = reliability**2 * np.minimum(*(slow / (fast + allowed_px**2) for slow, fast in parts))
    low, high = AGREES
    agreed = np.clip((agreement(tracks, scene, significance > MIN_SIGNIFICANCE) - low) / (high - low), 0, 1)
    of_track = significance**2 / (significance**2 + 1) * agreed
    here = np.minimum(*(share_here(tracks, of) for of in residuals)) / HERE
    return np.asarray(of_track[tracks.track] * np.minimum(here, 1))


def share_here(tracks: Tracks, increments: np.ndarray) -> np.ndarray:
    """Power [M] of the increments [M - n, 2] of a track around each sighting, as a share of its mean along the track.

    Of increments smoothed over AROUND steps; a sighting has the mean of the steps to it and from it.
    """
    steps = tracks.lengths - 1
    track = np.repeat(np.arange(len(steps)), steps)
    total, count = np.zeros_like(increments), np.zeros((len(track), 1))
    reach = round(3 * AROUND)
    for offset in range(-reach, reach + 1):
        begin, end = max(-offset, 0), len(track) - max(offset, 0)
        same = (track[begin:end] == track[begin + offset : end + offset])[:, None]
        weight = np.exp(-(offset**2) / (2 * AROUND**2)) * same
        total[begin:end] += weight * increments[begin + offset : end + offset]
        count[begin:end] += weight
    power = ((total / count) ** 2).sum(axis=1)
    share = power / (tracks.sum(power, track) / steps + TINY)[track]
    at = np.delete(np.arange(len(tracks.frame)), tracks.first[1:] - 1)  # the sighting at which each step begins
    found, sides = np.zeros((2, len(tracks.frame)))
    for sighting in (at, at + 1):
        found[sighting] += share
        sides[sighting] += 1
    return np.asarray(found / sides)


def slow_and_fast(tracks: Tracks, increments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean power [n] px^2 of the increments [M - n, 2] of each track in its slow cosines, and in the others.

    A track of m steps has max(1, m / PERIOD) slow ones; the basis is that of the discrete cosine transform.
    """
    steps = tracks.lengths - 1
    track = np.repeat(np.arange(len(steps)), steps)
    at = (np.arange(len(track)) - np.repeat(np.cumsum(steps) - steps, steps) + 0.5) / steps[track]
    counts = np.maximum(1, np.rint(steps / PERIOD)).astype(int)
    slow = np.zeros(len(steps))
    for k in range(counts.max()):
        cosine = np.cos(np.pi * k * at) * np.sqrt((2 if k else 1) / steps[track])
        for channel in increments.T:
            slow += (k < counts) * tracks.sum(cosine * channel, track) ** 2
    total = tracks.sum((increments**2).sum(axis=1), track)
    return slow / (2 * counts), np.maximum(total - slow, 0) / np.maximum(2 * (steps - counts), 1)


def agreement(tracks: Tracks, scene: StaticScene, asked: np.ndarray) -> np.ndarray:
    """Share [n], -1..1, by which pictures agree better along a track than at the static scene; 0 if not asked [n].

    (E_static - E_track) / (E_static + E_track) with sums E of squared differences of the detail around its sightings.
    The static scene is that of the depth of the surroundings that comes nearest to the track, or its own, the better.
    """
    track, lengths = tracks.track, tracks.lengths
    at = np.arange(len(track)) - tracks.first[track]
    gap = np.minimum(GAP, np.maximum(lengths // 2, EVERY))[track]
    here = np.flatnonzero(asked[track] & (at % EVERY == 0) & (at + gap < lengths[track]))
    if not len(here):
        return np.zeros(len(lengths))
    there = here + gap[here]
    i, j, uv = tracks.frame[here], tracks.frame[there], tracks.uv[here]
    far, near, own = scene.depths(i, uv)
    projected = Projected(*scene.projections(i, j), uv)
    seen = scene.patches(i, uv, PATCH_PX)

    def difference(where: np.ndarray) -> np.ndarray:
        return np.asarray(((scene.patches(j, where, PATCH_PX) - seen) ** 2).sum(axis=1))

    along = difference(tracks.uv[there])
    nearest = np.clip(projected.nearest(tracks.uv[there]), far, near)
    static = np.minimum(difference(projected.at(nearest)), difference(projected.at(own)))
    along, static = (tracks.sum(values, track[here]) for values in (along, static))
    return np.asarray((static - along) / (static + along + TINY))


def _steps(tracks: Tracks, scene: StaticScene) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray, np.ndarray]:
    """Residuals [M - n, 2] px of the steps, with and without what the frame has in common; per track [n] the error px
    that is allowed of them, and how reliable its flow is, 0..1."""
    here = np.delete(np.arange(len(tracks.frame)), tracks.first[1:] - 1)
    track, i, uv, moved = tracks.track[here], tracks.frame[here], tracks.uv[here], tracks.uv[here + 1]
    far, near, _ = scene.depths(i, uv)
    projected = Projected(*scene.projections(i, i + 1), uv)
    residual = moved - projected.at(np.clip(projected.nearest(moved), far, near))
    span_px = np.linalg.norm(projected.at(near) - projected.at(far), axis=1)
    steps = tracks.lengths - 1
    allowed_px = FLOOR_PX + PER_PX * np.linalg.norm(moved - uv, axis=1) + PER_SPAN * span_px
    reliability = np.minimum(tracks.sum(scene.confidence(i, uv), track) / steps / RELIABLE, 1)
    return (residual, residual - scene.common(i, uv)), tracks.sum(allowed_px, track) / steps, reliability
