"""Tracks as tables of tracks by frames, in which tests state them, and as lists of sightings, in which stages do."""

import numpy as np

from stages.control.sightings import Sightings
from stages.control.tracks import Tracks


def table(tracks: Tracks | Sightings) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [n, F, 2], 0 where not visible, and whether a track is visible in a frame [n, F]."""
    F = tracks.F if isinstance(tracks, Tracks) else len(tracks.frames)
    uv, visible = np.zeros((tracks.n, F, 2)), np.zeros((tracks.n, F), bool)
    uv[tracks.track, tracks.frame], visible[tracks.track, tracks.frame] = tracks.uv, True
    return uv, visible


def sightings(
    frames: np.ndarray,
    times: np.ndarray,
    visible: np.ndarray,
    uv: np.ndarray,
    depth: np.ndarray,
    std: np.ndarray,
    moved: np.ndarray,
) -> Sightings:
    """Sightings of n tracks in F frames from visible, depth and std [n, F], uv [n, F, 2] and moved [n, F, 3]."""
    values = (part[visible] for part in (uv, depth, std, moved))
    return Sightings(frames, times, len(visible), *np.nonzero(visible), *values)
