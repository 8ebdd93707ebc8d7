"""Where and when shadows of movers pass over the static scene: the colours over time that training begins with."""

import cv2
import numpy as np
import torch

from stages.gaussians.training_frames import TrainingFrames
from stages.gaussians.votes import DEPTH_TOLERANCE, pixels_of
from stages.shared.images import LIGHT_CHANGES
from stages.shared.log import logger, progress
from stages.splatting.cloud import Cloud
from stages.splatting.sh import C0
from stages.splatting.shadows import ShadowTable

SPACING = 2.0
"""Side of the cubes of space that have a colour over time, in distances of neighbouring Gaussians."""
RADIUS = 0.6
"""Kernel radius of the point in the middle of a cube, in its sides."""
WINDOW_PX = 5
"""Pixels, each way, over which colours are averaged: misplaced texture looks like a change of light."""
DARKEST = 1 / 255
"""Colours in 0..1 that gains are told from."""
LEAST_SEEN = 4
"""Frames that must show a cube."""


def moving_shadows(seen: TrainingFrames, cloud: Cloud) -> ShadowTable | None:
    """Colours over time of the cubes of space whose static Gaussians change theirs; None if none do.

    A cube changes where its mean colour leaves the median over the frames by LIGHT_CHANGES, in two frames behind one
    another and towards the same side. Where a cube is not seen its change is interpolated between the frames.
    """
    static = ~cloud.dynamic.numpy()
    means, footprints = cloud.means.double().numpy()[static], cloud.footprints.double().numpy()[static]
    cube, sides = _cubes(means, footprints)
    change = _changes(seen, means, cube, len(sides))
    changes = np.flatnonzero(_is_changing(change.mean(axis=-1)))
    if not len(changes):
        return None
    middles = np.stack([np.bincount(cube, along) for along in means.T], axis=-1) / np.bincount(cube)[:, None]
    points = middles[changes]
    table = ShadowTable(
        torch.as_tensor(seen.times), torch.from_numpy(points).float(), torch.from_numpy(RADIUS * sides[changes]).float()
    )
    table.table.data = torch.from_numpy(_filled(change[:, changes], seen.times) / C0).float()
    logger.info("light changes in %d of %d cubes of the static scene", len(changes), len(sides))
    return table


def _cubes(means: np.ndarray, footprints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The cube [n] of each point, and the side of each cube: SPACING footprints, rounded to a power of two."""
    sides = SPACING * 2.0 ** np.rint(np.log2(footprints))
    keys = np.column_stack([sides, np.floor(means / sides[:, None])])
    cubes, index = np.unique(keys, axis=0, return_inverse=True)
    return index.ravel(), cubes[:, 0]


def _changes(seen: TrainingFrames, means: np.ndarray, cube: np.ndarray, cubes: int) -> np.ndarray:
    """Mean colour of each cube in each frame less its median over the frames, [F, cubes, 3]; nan where it is hidden.

    Gains of whole frames are taken out: the median of the cubes.
    """
    colours = np.full((len(seen.images), cubes, 3), np.nan, np.float32)
    around = np.ones((WINDOW_PX, WINDOW_PX), np.uint8)
    for f in progress(range(len(colours)), "light on the static scene"):
        u, v, z, shown = pixels_of(seen, f, means)
        hidden = cv2.dilate(seen.masks[f].astype(np.uint8), around) > 0
        shown &= ~hidden[v, u] & (np.abs(z / seen.depths[f][v, u] - 1) < DEPTH_TOLERANCE)
        smooth = cv2.blur(seen.images[f], (WINDOW_PX, WINDOW_PX))[v[shown], u[shown]]
        count = np.bincount(cube[shown], minlength=cubes)
        total = np.stack([np.bincount(cube[shown], channel, cubes) for channel in smooth.T], axis=-1)
        colours[f, count > 0] = (total / np.maximum(count, 1)[:, None])[count > 0]
    colours[:, np.isfinite(colours[..., 0]).sum(axis=0) < LEAST_SEEN] = np.nan
    known = np.isfinite(colours[..., 0]).any(axis=0)
    if known.any():
        shares = colours[:, known] / np.maximum(np.nanmedian(colours[:, known], axis=0), DARKEST)
        gains = [np.nanmedian(of, axis=0) if np.isfinite(of).any() else np.ones(3) for of in shares]
        colours /= np.stack(gains)[:, None].astype(np.float32)
        colours[:, known] -= np.nanmedian(colours[:, known], axis=0)
    return colours


def _is_changing(change: np.ndarray) -> np.ndarray:
    """Whether [n] changes [F, n] leave 0 by LIGHT_CHANGES to one side in two frames behind one another."""
    sides = np.where(np.abs(change) > LIGHT_CHANGES, np.sign(change), 0)
    return np.asarray((sides[1:] * sides[:-1] > 0).any(axis=0))


def _filled(change: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Changes [F, n, 3] with those that are not known interpolated in time."""
    filled = change.copy()
    for k in range(change.shape[1]):
        known = np.isfinite(change[:, k, 0])
        for c in range(3):
            filled[:, k, c] = np.interp(times, times[known], change[known, k, c])
    return filled
