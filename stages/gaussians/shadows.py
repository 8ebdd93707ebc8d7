"""Where and when shadows of movers pass over the static scene: the colours over time that training begins with."""

import warnings

import cv2
import numpy as np
import torch

from stages.gaussians.training_frames import TrainingFrames
from stages.gaussians.votes import DEPTH_TOLERANCE, pixels_of
from stages.shared.light import BRIGHT, DARK, LIGHT_CHANGES
from stages.shared.log import logger, progress
from stages.splatting.cloud import Cloud
from stages.splatting.sh import C0
from stages.splatting.shadows import ShadowTable

SPACING = 2.0
"""Side of the cubes of space that have a colour over time, in distances of neighbouring Gaussians; of a long clip, in
which many change, twice as much, or four times."""
RADIUS = 0.6
"""Kernel radius of the point in the middle of a cube, in its sides."""
WINDOW_PX = 5
"""Pixels, each way, over which colours are averaged: misplaced texture looks like a change of light."""
ROUNDS = 4
"""Times that gains are taken out: a cube that is clipped in the brighter frames is usually seen in the darker ones."""
MOST_OFFSETS, PARTS = 400_000, 16
"""Points times frames, at most; and parts of the cubes whose medians are found one after the other, to save memory."""
LEAST_SEEN = 4
"""Frames that must show a cube."""


def moving_shadows(seen: TrainingFrames, cloud: Cloud) -> ShadowTable | None:
    """Colours over time of the cubes of space whose static Gaussians change theirs; None if none do.

    A cube changes where its mean colour leaves the median over the frames by LIGHT_CHANGES, in two frames behind one
    another and towards the same side. Where a cube is not seen its change is interpolated between the frames.
    """
    static = ~cloud.dynamic.numpy()
    means, footprints = cloud.means.double().numpy()[static], cloud.footprints.double().numpy()[static]
    spacing, most = SPACING, MOST_OFFSETS // len(seen.images)
    while True:
        cube, sides = _cubes(means, spacing * footprints)
        change = _changes(seen, means, cube, len(sides))
        changes = np.flatnonzero(_is_changing(change.mean(axis=-1)))
        if len(changes) <= most:
            break
        spacing *= 2
    if not len(changes):
        return None
    middles = np.stack([np.bincount(cube, along) for along in means.T], axis=-1) / np.bincount(cube)[:, None]
    points, radii = (torch.from_numpy(of[changes]).float() for of in (middles, RADIUS * sides))
    table = ShadowTable(torch.as_tensor(seen.times), points, radii)
    table.table.data = torch.from_numpy(_filled(change[:, changes], seen.times) / C0).float()
    logger.info("light changes in %d of %d cubes of the static scene", len(changes), len(sides))
    return table


def _cubes(means: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The cube [n] of each point, and the side of each cube: that of its points [n], rounded to a power of two."""
    sides = 2.0 ** np.rint(np.log2(sides))
    keys = np.column_stack([sides, np.floor(means / sides[:, None])])
    cubes, index = np.unique(keys, axis=0, return_inverse=True)
    return index.ravel(), cubes[:, 0]


def _changes(seen: TrainingFrames, means: np.ndarray, cube: np.ndarray, cubes: int) -> np.ndarray:
    """Mean colour of each cube in each frame less its median over the frames, [F, cubes, 3]; nan where it is hidden.

    Gains of whole frames are taken out: the median of the cubes.
    """
    colours = np.full((len(seen.images), cubes, 3), np.nan, np.float32)
    for f in progress(range(len(colours)), "light on the static scene"):
        rows, shown, usable = _shown(seen, f, means)
        count = np.bincount(cube[rows], minlength=cubes)
        total = np.stack([np.bincount(cube[rows], channel, cubes) for channel in shown.T], axis=-1)
        lit = (count > 0) & (np.bincount(cube[rows], ~usable, cubes) == 0)
        colours[f, lit] = total[lit] / count[lit, None]
    colours[:, np.isfinite(colours[..., 0]).sum(axis=0) < LEAST_SEEN] = np.nan
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # of medians of nothing, which are nan
        for _ in range(ROUNDS):
            usual = np.concatenate([np.nanmedian(of, axis=0) for of in np.array_split(colours, PARTS, axis=1)])
            for of in colours:
                of /= np.nanmedian(of / usual, axis=0)
        for of in np.array_split(colours, PARTS, axis=1):
            of -= np.nanmedian(of, axis=0)
    return colours


def _shown(seen: TrainingFrames, f: int, means: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows [k] of the points [n, 3] that frame f shows, the colours [k, 3] around them, and whether [k] these are
    neither dark nor clipped."""
    u, v, z, inside = pixels_of(seen, f, means)
    hidden = seen.masks[f] if seen.scene is None else seen.masks[f] | ~seen.scene
    around = np.ones((WINDOW_PX, WINDOW_PX), np.uint8)
    hidden = cv2.dilate(hidden.astype(np.uint8), around) > 0
    rows = np.flatnonzero(inside & ~hidden[v, u] & (np.abs(z / seen.depths[f][v, u] - 1) < DEPTH_TOLERANCE))
    brightest = cv2.dilate(seen.images[f], around)[v[rows], u[rows]]
    colours = cv2.blur(seen.images[f], (WINDOW_PX, WINDOW_PX))[v[rows], u[rows]]
    return rows, colours, ((colours > DARK) & (brightest < BRIGHT)).all(axis=1)


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
