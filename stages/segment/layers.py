"""Evidence from the pictures of what belongs to a mover: its own motion against that of the static scene.

Masks from the flow alone are precise but not whole: flow is lost on arms, thin parts and in front of texture that
wins. What is found of a mover gives its motion, extended to what is around. Where the pictures match better when they
are moved with it than at the depth of the static scene, the pixel belongs to it. The reverse is evidence against, but
not of what is known to move: the parts of a mover do not all move alike. Ground that movers cover for a part of the
time is an exception: other frames show it (`uncovered`).
"""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np

from stages.segment.background import against_background
from stages.segment.matching import REACH, compared, static_depths
from stages.segment.permanence import DYNAMIC
from stages.segment.static_world import StaticWorld
from stages.segment.superpixels import Superpixels
from stages.segment.uncovered import DISTANCES, Around, frames_around, seen_again
from stages.shared.flow_pairs import FlowPairs
from stages.shared.picture_difference import EVERY_PX, exposed, noise_of, tolerance
from stages.shared.threads import threaded
from stages.shared.warp import look_up

STATIC = 0.3
"""Sureness from which on a pixel says nothing of the depth behind a mover."""
MOVING, RESTING = 0.25, 0.1
"""Weight of a pixel that the pictures give to a mover, relative to that of certain motion by the flow, and of one that
they give to the static scene."""
CLEAR = 0.1, 0.4
"""Difference of the residuals, in tolerances, from which on it counts, and from which on fully."""
MATCHED = 1.0
"""Residual of the mover, in tolerances, up to which it explains the pictures; from twice as much on it does not."""
SURELY_MATCHED = 0.75
"""The same for a single pixel, of the mover or of the static scene: no mean over a superpixel makes up for chance."""
SOUGHT, SOUGHT_PX = 0.2, 4
"""What is surer than this, and so many pixels around it, is compared with frames in which movers do not cover it."""
UNSURE, SURE_FRAMES = 0.25, 2
"""But not where the mean confidence of the flow to frames at most SURE_FRAMES away is larger,"""
MOST = 0.7
"""nor in frames of which more moves: cameras may then be those of a mover, which seems to rest."""
SHOWN_MOST = 127
"""What a pixel shows is kept in units of 1 / 127, in one byte."""
MOST_CODED = 20.0
"""Residual, in tolerances, from which on a larger one tells no more."""
NEAR_ENOUGH = 0.15
"""Share of a mover among the pixels around, from which on its extended motion counts fully."""


class Belonging(NamedTuple):
    """What the pictures give to movers, and, negative, to the static scene.

    Attributes:
        weight: [N] with which they say so of a superpixel, relative to certain motion by the flow.
        asked: [N] share of its pixels that were compared; 0 in frames of which masks hold more than MOST.
        pixels: [T, h, w] int8, how clearly they say so of a pixel, -SHOWN_MOST to SHOWN_MOST.
        evidence: [T, 6, h, w] uint8, the same in parts, in units of 1 / 255: `coded` residuals of the static scene and
            of the mover, how far the frame lies from the background, in tolerances and over how far the frames around
            lie from one another; the share of movers around, and the confidence of the flow. Without frames if it was
            not asked for.
    """

    weight: np.ndarray
    asked: np.ndarray
    pixels: np.ndarray
    evidence: np.ndarray

    def of_frame(self, k: int) -> np.ndarray:
        """How clearly [h, w] each pixel of frame k moves, -1..1."""
        return np.asarray(self.pixels[k].astype(np.float32) / SHOWN_MOST)

    def in_parts(self, k: int) -> np.ndarray | None:
        """The evidence [6, h, w] of frame k, in 0..1; None where nothing was compared, or it was not asked for."""
        return np.asarray(self.evidence[k] / np.float32(255)) if self.evidence[k : k + 1].any() else None


def belonging(
    pixels: Superpixels,
    pairs: FlowPairs,
    picture: Callable[[int], np.ndarray],
    world: StaticWorld,
    sure: np.ndarray,
    in_parts: bool = True,
) -> Belonging:
    """What the pictures of a clip give to its movers and to the static scene.

    Args:
        picture: gives frame k [h, w, 3] uint8 on the flow grid.
        sure: [N] of `permanence.persistent`, from DYNAMIC on what is known to move.
        in_parts: whether the evidence is asked for in parts too, as the network reads it.
    """
    T, found = len(pixels.labels), []
    shown = np.zeros(pixels.labels.shape, np.int8)
    evidence = np.zeros((T * in_parts, 6, *pixels.labels.shape[1:]), np.uint8)

    def of_frame(k: int, frames: dict[int, np.ndarray], covered: dict[int, np.ndarray]) -> np.ndarray:
        """Means [5, n] over the n superpixels of frame k: by how much the static residual is larger, residual of the
        mover, share of movers around, what rests by other frames, share compared."""
        part, seen = pixels.part(k, k + 1), pixels.paint(sure, k).astype(np.float32)
        if not (seen >= DYNAMIC).any():
            return np.zeros((5, len(part.areas)))
        depths = static_depths(world, k, np.maximum(1 - seen / STATIC, 0) ** 2)
        allowed, confidence = tolerance(frames[k], _noise(k, pairs, frames)), _confidence(k, pairs)
        static, moved, share, known = compared(k, seen, allowed, depths, pairs, frames, world)
        asked = known * ((seen >= DYNAMIC).mean() <= MOST)
        limit = np.where(_sought(seen, confidence), np.maximum(2 * SURELY_MATCHED, moved + 1) * allowed, 0)
        compare = in_parts or (limit > 0).any()
        around = frames_around(k, depths[0], frames, covered, world) if compare else None
        again, apart, spread = _by_others(depths, limit, (known > 0) & in_parts, around)
        again /= allowed  # above the limit it changes nothing
        rests = _clear(again - moved)[1] * _matches(again, SURELY_MATCHED)
        static = np.minimum(static, again)
        moving, resting = _clear(static - moved)
        clear = moving * _matches(moved, SURELY_MATCHED) - resting * _matches(static, SURELY_MATCHED)
        shown[k] = np.rint(SHOWN_MOST * _near(share) * clear)
        if in_parts and known.any():
            parts = *map(coded, (static, moved, apart / allowed, apart / (spread + allowed))), share, confidence
            evidence[k] = np.rint(255 * np.clip(parts, 0, 1))
        images = np.clip(static - moved, -1, 1), np.minimum(moved, 2 * MATCHED), share, rests, asked
        return np.stack([part.means([image]) for image in images])

    frames: dict[int, np.ndarray] = {}
    for first, last in pairs.blocks(T, "movers against the static scene"):
        reach = max(REACH, DISTANCES[-1])
        near = range(max(first - reach, 0), min(last + reach, T))
        new = [k for k in near if k not in frames]
        read = dict(zip(new, threaded(picture, new), strict=True))
        frames = {k: read[k] if k in read else frames[k] for k in near}
        covered = {k: _covered(pixels.paint(sure, k), pairs.scene) for k in near}
        found += threaded(of_frame, range(first, last), *(itertools.repeat(of) for of in (frames, covered)))
    excess, residual, share, rests, asked = np.concatenate(found, axis=1)
    moving, resting = _clear(excess)
    weight = MOVING * moving * _matches(residual, MATCHED) - RESTING * (resting * (sure < DYNAMIC) + rests)
    return Belonging(_near(share) * weight, asked, shown, evidence)


def _noise(i: int, pairs: FlowPairs, frames: dict[int, np.ndarray]) -> np.ndarray:
    """`noise_of` frame i [h, w], by the frames at most SURE_FRAMES away."""
    every, apart, inside = np.s_[::EVERY_PX, ::EVERY_PX], [], []
    for e in pairs.leaving(i, i + 1):
        if abs(int(pairs.target[e]) - i) <= SURE_FRAMES:
            flow = pairs.flow[e].astype(np.float32)
            there, known = look_up(frames[int(pairs.target[e])], flow, every)
            apart.append(np.abs(exposed(frames[i], there)[every].astype(np.float32) - there).mean(axis=2))
            inside.append(known)
    shape = (len(apart), *frames[i][every].shape[:2])
    return noise_of(frames[i], np.reshape(apart, shape), np.reshape(inside, shape).astype(bool))


def _clear(excess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How clearly, 0..1, a static residual that is larger by this much speaks of motion, and of rest, of any shape."""
    low, high = CLEAR
    moving, resting = (np.clip((of - low) / (high - low), 0, 1) for of in (excess, -excess))
    return moving, resting


def _matches(residual: np.ndarray, matched: float) -> np.ndarray:
    """How well, 0..1, a residual of any shape explains the pictures: fully up to `matched`, from twice that on not."""
    return np.asarray(np.clip(2 - residual / matched, 0, 1))


def _near(share: np.ndarray) -> np.ndarray:
    """How far, 0..1, the motion of movers counts that are this share of the pixels around, of any shape."""
    return np.asarray(np.clip(share / NEAR_ENOUGH, 0, 1))


def coded(residual: np.ndarray) -> np.ndarray:
    """A residual of any shape, in tolerances, as a number from 0 to 1: the logarithm, up to MOST_CODED."""
    return np.asarray(np.log1p(np.minimum(residual, MOST_CODED)) / np.log1p(MOST_CODED))


def _by_others(depths: list[np.ndarray], limit: np.ndarray, asked: np.ndarray, around: Around | None) -> np.ndarray:
    """`seen_again`, and `against_background`, [3, h, w]; infinite and 0 where there are no frames around."""
    if around is None:
        return np.stack([np.full(limit.shape, np.inf, np.float32), *np.zeros((2, *limit.shape), np.float32)])
    return np.stack([seen_again(limit, depths, around), *against_background(depths[0], asked, around)])


def _confidence(i: int, pairs: FlowPairs) -> np.ndarray:
    """Mean confidence [h, w] of the flow of frame i to frames at most SURE_FRAMES away."""
    near = [e for e in pairs.leaving(i, i + 1) if abs(int(pairs.target[e]) - i) <= SURE_FRAMES]
    maps = [pairs.confidence[e].astype(np.float32) for e in near]
    return np.mean(maps, axis=0) if maps else np.zeros(pairs.confidence.shape[1:], np.float32)


def _sought(sure: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    """Where [h, w] bool movers are near, and the flow does not know what a pixel does."""
    if (sure >= DYNAMIC).mean() > MOST:
        return np.zeros(sure.shape, bool)
    around = cv2.dilate(sure, np.ones((1 + 2 * SOUGHT_PX,) * 2, np.uint8)) > SOUGHT
    return np.asarray(around & (confidence < UNSURE))


def _covered(sure: np.ndarray, scene: np.ndarray | None) -> np.ndarray:
    """Where [h, w] bool a frame shows movers, or what is burnt into it."""
    return np.asarray((sure >= DYNAMIC) if scene is None else (sure >= DYNAMIC) | ~scene)
