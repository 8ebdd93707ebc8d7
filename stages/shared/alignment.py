"""Least-squares similarity between two sets of points (Umeyama, IEEE TPAMI 13(4), 1991)."""

import numpy as np

RANK_TOLERANCE = 1e-8
"""Points extend in a direction if they spread over more than this share of the widest one, and beyond rounding."""


class DegenerateError(ValueError):
    """The points do not determine a similarity.

    Attributes:
        which: "source", "target", or "both" if each set determines a plane but their covariance has rank one.
        shape: "point" (all points coincide) or "line" (the rotation about the line is undetermined).
    """

    def __init__(self, which: str, shape: str) -> None:
        self.which, self.shape = which, shape
        super().__init__(f"no unique similarity: {which} points determine no more than a {shape}")


def umeyama(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """The similarity that minimises sum ||target - (scale R source + t)||^2.

    Args:
        source: points [T, 3], any unit.
        target: corresponding points [T, 3].

    Returns:
        scale > 0, rotation R [3, 3] (det +1), translation t [3].

    Raises:
        ValueError: for shapes other than two equal [T, 3], or values that are not finite.
        DegenerateError: if either set, or the covariance of both, extends in fewer than two directions.
    """
    source, target = np.asarray(source, float), np.asarray(target, float)
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise ValueError(f"expected two arrays [T, 3], found {source.shape} and {target.shape}")
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise ValueError("expected finite points")
    for which, points in (("source", source), ("target", target)):
        shape = extent(points)
        if shape != "volume":
            raise DegenerateError(which, shape)
    mean_s, mean_t = source.mean(axis=0), target.mean(axis=0)
    centred_s, centred_t = source - mean_s, target - mean_t
    # Dividing by the spreads first avoids under- and overflow of the covariance in tiny and huge scenes.
    spread_s, spread_t = np.sqrt((centred_s**2).sum()), np.sqrt((centred_t**2).sum())
    U, d, Vt = np.linalg.svd((centred_t / spread_t).T @ (centred_s / spread_s))  # eq. 38
    if d[1] <= np.finfo(float).eps:
        raise DegenerateError("both", "line")
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])  # eq. 39, 43: never a reflection
    R = (U * sign) @ Vt  # eq. 40
    scale = float(d @ sign * spread_t / spread_s)  # eq. 42
    return scale, R, mean_t - scale * R @ mean_s  # eq. 41


def extent(points: np.ndarray) -> str:
    """ "point", "line" or "volume" (including a plane): the space in which points [T, 3] extend, up to rounding."""
    centred = np.pad(points - points.mean(axis=0), ((0, 3), (0, 0)))  # zero rows: three values also for T < 3
    widest, second, _ = np.linalg.svd(centred, compute_uv=False)
    rounding = RANK_TOLERANCE * max(widest, 1e-6 * float(np.abs(points).max()))
    if widest <= rounding:
        return "point"
    return "line" if second <= rounding else "volume"
