"""The light that the shadows of a clip take away, learnt from the clip, and where the change of light is of this kind.

A surface in a moving shadow has its own colour times a gain, nearly the same in all shadows of one sun on one kind of
surface, ground or walls. Between two frames aligned by the static scene the logarithms of its colours change along one
direction, and by no more than in full shadow. What a mover covers, or uncovers, changes along any direction, and mostly
by more. Directions and depths are learnt where texture tells that a surface is at rest under light that changes
(`shadows`); they also hold where it does not: on plaster, asphalt and tiles.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import cv2
import numpy as np

from stages.motion.shadows import DARKEST, NEAR_PX, compared, log_detail
from stages.shared.static_flow import dense_static_flow
from stages.shared.threads import threaded
from stages.shared.warp import look_up, warp

SAMPLED = 24
"""Frames from which the light is learnt."""
EXPLAINED = 0.35
"""Residual of the flow from which on a pixel may be in a moving shadow."""
TEXTURED, ALIKE, CHANGED = 0.5, 0.6, 0.06
"""Least weight of the texture of a pixel from which the light is learnt, least share of it that is alike, and least
change, as a root mean square of the mean logarithm of its colours."""
LEAST_SEEN, MOST_SPREAD = 100, 0.13
"""Pixels that the light is learnt from at least, and the largest median distance of their directions from it."""
CLOSE, ROUNDS = 0.15, 10
"""Distance of a pixel's direction up to which it counts for the median, from round to round: among these pixels are
some of movers."""
COLOURED = 0.1
"""Least distance of the direction from that of grey: grey texture that moves a little changes along the latter too."""
DEEPEST = 95
"""Percentile of the largest changes of these pixels that is the depth of a full shadow."""
WITHIN = 1.1, 1.3
"""Change, as a share of that depth, up to which it may be a shadow's, and from which on it is none."""
FAINT = 0.1
"""Change of the logarithm of the colours along the direction at which it counts half."""
ACROSS = 0.08
"""Change across the direction, as a share of that along it, at which it counts half."""
COVERED = 0.25
"""Share of the frames around, about, in which what casts the shadow may hide the place. As many are left out: those
that do not show the place, then those that differ least as by a shadow."""
EXPOSURE_PX = 4
"""Every fourth pixel each way is enough to measure what exposure changes."""
TINY = 1e-6


class Shadow(NamedTuple):
    """Direction [3] of the change of the logarithm of the colours, of mean 1, and its mean in full shadow."""

    direction: np.ndarray
    depth: float


def log_colours(rgb: np.ndarray) -> np.ndarray:
    """Logarithm [h, w, 3] float32 of the colours of a frame [h, w, 3] uint8."""
    return np.log(cv2.GaussianBlur(rgb, (0, 0), 0.7).astype(np.float32) + np.float32(DARKEST))


class View(NamedTuple):
    """A frame of a static world in the frames around it: targets [E], A [E, 3, 3], b [E, 3], inverse depth [h, w].

    A and b are those of `resweep`, or of every row (`rolling`).
    """

    targets: np.ndarray
    A: np.ndarray
    b: np.ndarray
    inverse_depth: np.ndarray

    def ways(self) -> Iterator[tuple[int, np.ndarray]]:
        """Each target, and the flow [h, w, 2] of the static world to it."""
        for j, A, b in zip(self.targets, self.A, self.b, strict=True):
            yield int(j), dense_static_flow(A, b, self.inverse_depth)


def changes(colours: dict[int, np.ndarray], i: int, view: View) -> np.ndarray:
    """Change [E, h, w, 3] of the logarithm of the colours of frame i from other frames, if it is at rest.

    Relative to the median of the frame, as exposure changes too; 0 out of view.

    Args:
        colours: `log_colours` per frame.
    """
    found = np.zeros((len(view.targets), *colours[i].shape), np.float32)
    for change, (j, way) in zip(found, view.ways(), strict=True):
        there, inside = look_up(colours[j], way)
        difference = colours[i] - there
        difference -= np.median(difference[::EXPOSURE_PX, ::EXPOSURE_PX], axis=(0, 1))
        cv2.blur(difference, (NEAR_PX, NEAR_PX), dst=change)
        change[~inside] = 0
    return found


def shadows_of_clip(rgb: np.ndarray, residual: np.ndarray, view: Callable[[int], View]) -> list[Shadow]:
    """The light that shadows take away, from frames spread over the clip; none if it cannot be told.

    Args:
        rgb: [T, h, w, 3] uint8; residual: [T, h, w] of the flow to a static world; view: gives that of frame k.
    """

    def of_frame(i: int) -> np.ndarray:
        seen = view(i)
        near = {i, *seen.targets.tolist()}
        colours, details = ({k: of(rgb[k]) for k in near} for of in (log_colours, log_detail))
        return seen_at_rest(details, i, seen, changes(colours, i, seen), residual[i])

    sampled = np.unique(np.linspace(0, len(rgb) - 1, SAMPLED).round().astype(int))
    return learnt(np.concatenate(threaded(of_frame, sampled.tolist())))


def seen_at_rest(
    details: dict[int, np.ndarray], i: int, view: View, changed: np.ndarray, residual: np.ndarray
) -> np.ndarray:
    """Direction, as in `Shadow`, and largest change, [n, 4], of pixels whose light changes and whose texture rests.

    Args:
        details: `shadows.log_detail` per frame; changed: [E, h, w, 3] of `changes`.
        residual: [h, w] of the flow to a static world.
    """
    means = sum(np.moveaxis(changed, -1, 0)) / changed.shape[-1]
    power = means**2
    counted, alike = np.zeros((2, *residual.shape), np.float32)
    for of_edge, (j, way) in zip(power, view.ways(), strict=True):
        weight, share = compared(details[i], warp(details[j], way))
        counted += of_edge * weight
        alike += of_edge * weight * share
    total = power.sum(axis=0)
    counted, alike, around = (cv2.blur(x, (NEAR_PX, NEAR_PX)) for x in (counted, alike, total))
    textured = (counted > TEXTURED * around) & (alike > ALIKE * counted)
    rests = textured & (total > len(means) * CHANGED**2) & (residual > EXPLAINED)
    directions = (means[..., None] * changed).sum(axis=0)[rests] / total[rests][:, None]
    return np.column_stack([directions, np.abs(means).max(axis=0, initial=0)[rests]])


def learnt(seen: np.ndarray) -> list[Shadow]:
    """The light that shadows take away, from the pixels [n, 4] of `seen_at_rest`, on ground, on walls and so on.

    None if they are few or disagree, or if that light is grey. What is far from it may be shadow elsewhere: where less
    of the sun is missed, or the light that remains is another, colours change along another direction.
    """
    found: list[Shadow] = []
    while len(seen) >= LEAST_SEEN:
        close = np.ones(len(seen), bool)
        for _ in range(ROUNDS):
            direction = np.median(seen[close, :3], axis=0)
            direction /= direction.mean()
            distance = np.linalg.norm(seen[:, :3] - direction, axis=1)
            close = distance < CLOSE
            if not close.any():
                return found
        if np.median(distance) > MOST_SPREAD or np.linalg.norm(direction - 1) < COLOURED:
            return found
        found.append(Shadow(direction, float(np.percentile(seen[close, 3], DEEPEST))))
        seen = seen[~close]
    return found


def in_shadow(changed: np.ndarray, shadows: list[Shadow]) -> np.ndarray:
    """How clearly [h, w], 0..1, the changes [E, h, w, 3] of a pixel are those of a moving shadow of some kind.

    Of the E frames about a quarter does not count (COVERED): who casts the shadow may hide the place in them.
    """
    return np.asarray(np.maximum.reduce([_in_shadow(changed, shadow) for shadow in shadows]))


def _in_shadow(changed: np.ndarray, shadow: Shadow) -> np.ndarray:
    along = changed @ (shadow.direction / np.linalg.norm(shadow.direction)).astype(np.float32)
    power, planes = along**2, np.moveaxis(changed, -1, 0)  # over the last axis, of three, numpy sums one by one
    across = np.maximum(sum(plane**2 for plane in planes) - power, 0)
    size = np.abs(sum(planes) / len(planes))
    unlike = np.where(planes.any(axis=0), across / (power + FAINT**2), np.inf)
    count = max(round((1 - COVERED) * len(changed)), 1)
    kept = np.argsort(unlike, axis=0, kind="stable")[:count]
    power, across, size = (np.take_along_axis(of_edge, kept, axis=0) for of_edge in (power, across, size))
    mean_power, mean_across = power.sum(axis=0) / count, across.sum(axis=0) / count
    aligned = 1 / (1 + (mean_across / (ACROSS**2 * mean_power + TINY)) ** 2)
    low, high = WITHIN
    shallow = np.clip((high - size.max(axis=0, initial=0) / shadow.depth) / (high - low), 0, 1)
    return np.asarray(mean_power / (mean_power + FAINT**2) * aligned * shallow)
