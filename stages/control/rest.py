"""Where tracked points rest in the canonical frame, and how control points that rest there move to begin with."""

import numpy as np
import torch
from scipy.spatial import cKDTree

from stages.control import canonical
from stages.control.fitting import NEIGHBOURS
from stages.control.sightings import Sightings
from stages.deformation import lbs
from stages.deformation.motion_models import TableDeformation

CARRIERS = 256
ALONE_RADII = 4.0
LONG_FRAMES, MOST_MOMENTS = 100, 8
"""Beyond so many training frames, what no track of the canonical frame carries rests at a moment of its own: a mover
that comes and goes has one for each visit. At most so many of them, besides."""
TRACKS_PER_POINT = 8


def worth_of(sightings: Sightings) -> np.ndarray:
    """Number [F] of observations of the tracks that each training frame sees."""
    lengths = np.diff(sightings.starts)
    return np.bincount(sightings.frame, lengths[sightings.track], len(sightings.frames))


def rest_positions(sightings: Sightings, frame: int) -> tuple[np.ndarray, int]:
    """Position of every track in the canonical frame.

    A track visible in `frame` has its position there. Any other is moved from its observation nearest in time by the
    inverse motion of the tracks around it. A track far from all others keeps the position of that observation; in a
    long clip these tracks get a canonical frame among themselves, and so on.

    Args:
        frame: in [0, F), seen by at least one track.

    Returns:
        positions float32 [n, 3], and the number of tracks that keep the position of an observation of their own.
    """
    rest, alone = _carried(sightings, frame)
    for _ in range(MOST_MOMENTS if len(sightings.frames) > LONG_FRAMES else 0):
        if not alone.any():
            break
        others = sightings.only(alone)
        at, still_alone = _carried(others, canonical.choose_frames(worth_of(others))[0])
        rest[alone] = at
        alone[alone] = still_alone
    return rest, int(alone.sum())


def _carried(sightings: Sightings, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions float32 [n, 3] of the tracks in a frame, and which [n] bool keep that of another one."""
    away = np.abs(sightings.frame - frame)
    nearest = np.lexsort((sightings.frame, away, sightings.track))[sightings.starts[:-1]]
    anchored = away[nearest] == 0
    rest = sightings.moved[nearest].astype(np.float32)
    chosen = canonical.farthest_points(rest[anchored], np.ones(anchored.sum()), CARRIERS)
    points = rest[anchored][chosen]
    carriers = TableDeformation(
        torch.from_numpy(points),
        torch.from_numpy(np.log(canonical.kernel_radii(points))).float(),
        torch.from_numpy(sightings.times),
    )
    known = sightings.only(anchored)
    seed_from_tracks(carriers, rest[anchored], known)
    watched = np.isin(np.arange(len(sightings.frames)), known.frame) | (len(sightings.frames) <= LONG_FRAMES)
    left = ~anchored
    for k in np.unique(sightings.frame[nearest[~anchored & watched[sightings.frame[nearest]]]]):
        members = np.flatnonzero(~anchored & (sightings.frame[nearest] == k))
        seen_at = torch.from_numpy(rest[members])
        with torch.no_grad():
            quats, translations = carriers(carriers.knots[k : k + 1])
        carried, remoteness = lbs.inverse_blend(
            seen_at, carriers.points, quats[0], translations[0], carriers.log_radii, NEIGHBOURS
        )
        alone = remoteness > ALONE_RADII
        rest[members] = torch.where(alone[:, None], seen_at, carried).numpy()
        left[members] = alone.numpy()
    return rest, left


def seed_from_tracks(deformation: TableDeformation, canonical: np.ndarray, sightings: Sightings) -> None:
    """Initialise the table, in place, with the median shift of the tracks nearest to each control point.

    Without it the photometric gradient never finds the motion, and the fit to tracks takes far longer. Rotations start
    at the identity: those of the Procrustes problem amplify errors of depth and are a worse initialisation.

    Of a long clip the nearest tracks see a small part, and less than the mover's visit: there, those nearest in each
    frame count.

    Args:
        canonical: [n, 3] tracked points. sightings: of the n tracks.
    """
    long = len(deformation.knots) > LONG_FRAMES
    shifts = (_shifts_by_frame if long else _shifts_of_nearest)(deformation, canonical, sightings)
    times = deformation.knots.numpy()
    for p in range(shifts.shape[1]):  # frames without an observation are interpolated
        known = np.isfinite(shifts[:, p, 0])
        at_times, seen = (times[known], shifts[known, p]) if known.any() else (times[:1], np.zeros((1, 3)))
        shifts[:, p] = np.stack([np.interp(times, at_times, seen[:, axis]) for axis in range(3)], axis=-1)
    with torch.no_grad():
        deformation.table[..., 4:] = torch.from_numpy(shifts) / deformation.extent


def _shifts_of_nearest(deformation: TableDeformation, canonical: np.ndarray, sightings: Sightings) -> np.ndarray:
    """Median shift [F, P, 3] of the tracks nearest to each control point, NaN in frames that see none of them."""
    nearest, _ = lbs.neighbours(torch.from_numpy(canonical), deformation.points, TRACKS_PER_POINT)
    shifts = np.full((len(deformation.knots), len(nearest), 3), np.nan)
    for p, tracks in enumerate(nearest.numpy()):
        moved, seen = sightings.spread(sightings.moved, tracks)
        known = seen.any(axis=0)
        shifts[known, p] = _medians(moved[:, known] - canonical[tracks][:, None], seen[:, known])
    return shifts


def _shifts_by_frame(deformation: TableDeformation, canonical: np.ndarray, sightings: Sightings) -> np.ndarray:
    """The same of the tracks that are nearest among those of each frame; none beyond ALONE_RADII counts."""
    points = deformation.points.double().numpy()
    reach = ALONE_RADII * np.exp(deformation.log_radii.detach().double().numpy())
    of_sighting = sightings.moved - canonical[sightings.track]
    shifts = np.full((len(deformation.knots), *points.shape), np.nan)
    order = np.argsort(sightings.frame, kind="stable")
    for k, rows in enumerate(np.split(order, np.searchsorted(sightings.frame[order], np.arange(1, len(shifts))))):
        if len(rows):
            at = cKDTree(canonical[sightings.track[rows]].astype(float))
            distance, nearest = at.query(points, k=np.arange(1, min(TRACKS_PER_POINT, len(rows)) + 1))
            near = distance[:, 0] <= reach
            counts = (distance[near] <= reach[near, None])[..., None]
            shifts[k, near] = np.nanmedian(np.where(counts, of_sighting[rows[nearest[near]]], np.nan), axis=1)
    return shifts


def _medians(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Median [F, 3] over the first axis of values [K, F, 3] where they are known [K, F], once at least in each."""
    ordered = np.sort(np.where(known[..., None], values, np.inf), axis=0)
    count = known.sum(axis=0)
    low, high = (ordered[rank, np.arange(len(count))] for rank in ((count - 1) // 2, count // 2))
    return np.asarray((low + high) / 2)
