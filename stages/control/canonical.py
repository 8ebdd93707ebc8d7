"""The canonical configuration: choice of the frame, positions of the control points and their kernel radii."""

import numpy as np
from scipy.spatial import cKDTree

MIN_RADIUS_SHARE = 0.1


def choose_frames(worth: np.ndarray) -> tuple[int, int]:
    """The training frame in [0, F) whose visible tracks have the most observations in total, and the next best.

    A frame at the end of the clip misses the tracks that end before it: -4.3 dB on a turning mover. The next best is
    at least a quarter of the clip away, since a neighbour would see the same tracks.

    Args:
        worth: [F] these numbers of observations.
    """
    F = len(worth)
    best = int(worth.argmax())
    far = np.abs(np.arange(F) - best) >= F / 4
    return best, int(np.where(far, worth, -1).argmax())


def farthest_points(points: np.ndarray, importance: np.ndarray, count: int) -> np.ndarray:
    """Greedy farthest-point sampling: indices of at most `count` distinct points of [n, 3], each far from those before.

    Args:
        importance: [n] > 0, multiplies a point's distance: regions of twice the importance get points twice as close.
    """
    chosen = [int(importance.argmax())]
    dist = np.full(len(points), np.inf)
    for _ in range(min(count, len(points)) - 1):
        dist = np.minimum(dist, np.linalg.norm(points - points[chosen[-1]], axis=1))
        if not dist.any():
            break
        chosen.append(int((importance * dist).argmax()))
    return np.array(chosen)


def kernel_radii(points: np.ndarray) -> np.ndarray:
    """Kernel radius [P] of each control point [P, 3]: the mean distance to the three nearest others.

    Coincident points get a tenth of the median radius, a point without others a unit of its own: 1.
    """
    K = min(3, len(points) - 1)
    if K == 0:
        return np.ones(len(points))
    dist, _ = cKDTree(points).query(points, k=K + 1)
    radii = dist[:, 1:].mean(axis=1)
    typical = float(np.median(radii)) or float(radii.max()) or 1.0
    return np.maximum(radii, MIN_RADIUS_SHARE * typical)


def speeds(uv: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Mean speed [n] of tracks uv [n, F, 2] px in px per frame, where they are visible [n, F] in both."""
    both = visible[:, 1:] & visible[:, :-1]
    steps = np.where(both, np.linalg.norm(np.diff(uv, axis=1), axis=-1), 0.0)
    return np.asarray(steps.sum(axis=1) / np.maximum(both.sum(axis=1), 1))


def motion_importance(speed: np.ndarray) -> np.ndarray:
    """Importance [n] in 1..2 of tracks for placing control points: it grows with their speed [n]."""
    fast = float(np.quantile(speed, 0.9))
    return 1 + np.clip(speed / fast, 0, 1) if fast > 0 else np.ones(len(speed))
