"""Votes of the training frames on lifted points: which of them show a point, masked or not."""

from collections.abc import Callable

import numpy as np

from stages.gaussians.training_frames import TrainingFrames
from stages.gaussians.vote_kernels import vote
from stages.shared.cameras import project
from stages.shared.frame_store import Computed, Frames
from stages.shared.threads import spread

DEPTH_TOLERANCE = 0.06
"""Relative difference of depth up to which two points count as the same surface."""
Tracks = Callable[[int], np.ndarray]
"""Positions [n, 3] of the points in a frame, by its index."""
Voters = Callable[[int], np.ndarray]
"""Whether [n] a frame, by its index, votes on each point."""


def pixels_of(
    seen: TrainingFrames, f: int, positions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Nearest pixel u, v [n] (0 if outside) and z-depth [n] of points [n, 3] in frame f, and whether it is inside.

    Pixels of what is burnt in do not count as inside.
    """
    height, width = seen.size
    xyz = positions @ seen.cam_from_world[f, :3, :3].T + seen.cam_from_world[f, :3, 3]
    front = xyz[:, 2] > 0
    uv = np.full((len(positions), 2), -1.0)
    uv[front] = project(positions[front], seen.cam_from_world[f], seen.Ks[f])[0]
    inside = (uv > -0.5).all(axis=1) & (uv[:, 0] < width - 0.5) & (uv[:, 1] < height - 0.5)
    u, v = np.where(inside[:, None], np.rint(uv), 0).astype(int).T
    return u, v, xyz[:, 2], inside if seen.scene is None else inside & seen.scene[v, u]


def dynamic_share(
    seen: TrainingFrames, tracks: Tracks, masks: Frames[np.ndarray], voters: Voters | None = None
) -> np.ndarray:
    """Share [n] of the frames in which a point is visible whose mask covers it; 0 for points that are never visible.

    A point is visible if it projects into the image and is not behind the depth there.

    Args:
        tracks: the positions [n, 3] in a frame, by its index.
        masks: F times [H, W] bool. voters: the frames that count, for each point; None: all.
    """
    return _share(seen, tracks, masks, at_surface=False, voters=voters)


def static_share(seen: TrainingFrames, positions: np.ndarray, masks: Frames[np.ndarray]) -> np.ndarray:
    """Share [n] of the frames in which a point at rest [n, 3] is visible that show it unmasked and on the surface.

    The surface test excludes points of movers: left at rest, they would float in front of the surface that other frames
    show.
    """
    return _share(seen, lambda _: positions, inverse(masks), at_surface=True)


def inverse(masks: Frames[np.ndarray]) -> Computed[np.ndarray]:
    """Masks that are true where `masks` are false."""
    return Computed(len(masks), lambda f: ~masks[f])


def _share(
    seen: TrainingFrames,
    tracks: Tracks,
    votes: Frames[np.ndarray],
    at_surface: bool,
    voters: Voters | None = None,
) -> np.ndarray:
    """Share [n] of the frames in which a point on its track is visible where votes, F times [H, W], are true."""
    n = len(tracks(0))
    totals = np.zeros((2, n))
    for f in range(len(seen.depths)):
        depth = seen.depths[f] if seen.scene is None else np.where(seen.scene, seen.depths[f], -np.inf)
        rows = slice(None) if voters is None else np.flatnonzero(voters(f))
        views, count = np.ascontiguousarray(totals[:, rows])
        positions, camera = np.ascontiguousarray(tracks(f)[rows], dtype=float), (seen.cam_from_world[f], seen.Ks[f])
        spread(vote, len(views), positions, *camera, depth, votes[f], 1 + DEPTH_TOLERANCE, at_surface, views, count)
        totals[:, rows] = views, count
    return totals[1] / np.maximum(totals[0], 1)
