"""The normal equations of the models of light (light_model.py), the radiances eliminated; linear in the frames.

What couples the gains of two frames is a point that both see. Tables of gains - one for all channels, or one for each -
are coupled through vignetting and fog alone. These are few: each table is solved by itself for the right side and for
their columns (Schur complement). In a long clip a frame shares points with few others, and a table's equations are
factorised as a sparse matrix.
"""

from typing import TYPE_CHECKING

import numpy as np

from stages.scene.light_model import Points

if TYPE_CHECKING:
    from scipy import sparse

DAMPING = 1e-6
"""Of the normal equations, as a share of their mean diagonal: holds gains of frames that see nothing."""


def normal_step(
    of: Points,
    fitted: tuple[np.ndarray, np.ndarray, np.ndarray],
    extras: list[np.ndarray],
    gains: int,
    trust: tuple[float, float],
) -> np.ndarray:
    """Steps of the gains, table by table, and of the K extras, from the normal equations without the radiances.

    Args:
        fitted: weights, slopes by the log radiance and errors [n, 3, S] of the sightings. extras: K derivatives
            [n, 3, S]. gains: number of tables, 0, 1 or 3. trust: further damping of all extras but the first, as a
            share of their diagonal, and of the second beside it.

    Returns:
        [gains F + K].
    """
    weight, slope, error = fitted
    weighted, K = weight * slope, len(extras)
    scatter = (weighted * slope).sum(axis=2)
    inverse = np.divide(1.0, scatter, out=np.zeros_like(scatter), where=scatter > np.finfo(scatter.dtype).tiny)

    def clear_of_radiance(values: np.ndarray) -> np.ndarray:
        return np.asarray(weight * (values - slope * ((weighted * values).sum(axis=2) * inverse)[..., None]))

    parts = [clear_of_radiance(values) for values in (*extras, error)]
    corner = np.array([[float(np.vdot(extra, part)) for part in parts] for extra in extras])
    tables = [range(first, 3, gains) for first in range(gains)]
    sides = [_sides(of, parts, channels) for channels in tables]
    systems = [_coupling(of, weight, weighted, inverse, channels) for channels in tables]
    gauges = [float(system.trace()) / of.F**2 for system in systems]  # the mean gain is that of the radiances
    trace = sum(gauges) * (of.F**2 + of.F) + float(np.trace(corner))
    level = DAMPING * max(trace / (gains * of.F + K), 1e-12)
    solved = [_solved(system, gauge, level, side) for system, gauge, side in zip(systems, gauges, sides, strict=True)]
    index = np.arange(K)
    corner[index, index] *= 1 + trust[0] * (index > 0) + trust[1] * (index == 1)
    corner[index, index] += level
    for side, solution in zip(sides, solved, strict=True):
        corner -= side[:, :K].T @ solution
    rest = np.linalg.solve(corner[:, :K], corner[:, K])
    return np.concatenate([*(solution[:, K] - solution[:, :K] @ rest for solution in solved), rest])


def _sides(of: Points, parts: list[np.ndarray], channels: range) -> np.ndarray:
    """Sums [F, K + 1] over the sightings of each frame, of the extras and of the errors [n, 3, S]."""
    return np.stack([np.sum([_per_frame(of, part[:, c]) for c in channels], axis=0) for part in parts], axis=1)


def _per_frame(of: Points, values: np.ndarray) -> np.ndarray:
    """Sums [F] of values [n, S]."""
    if not of.sparse:
        return np.asarray(values.sum(axis=0, dtype=float))
    return np.bincount(of.frame.ravel(), values.ravel(), of.F)


def _coupling(
    of: Points, weight: np.ndarray, weighted: np.ndarray, inverse: np.ndarray, channels: range
) -> "np.ndarray | sparse.csc_array":
    """The equations [F, F] of the gains of a table, without damping.

    Args:
        weighted: weights times slopes [n, 3, S]. inverse: [n, 3] of what holds the radiances.
    """
    if not of.sparse:
        system = np.zeros((of.F, of.F))
        for c in channels:
            product = weighted[:, c].T @ (inverse[:, c, None] * weighted[:, c])
            system += np.diag(_per_frame(of, weight[:, c])) - product
        return system
    from scipy import sparse  # a fraction of a second, which short clips spare

    n, S = of.frame.shape
    coupled = sparse.csc_array((of.F, of.F))
    for c in channels:
        rows = sparse.csr_array((weighted[:, c].ravel().astype(float), of.frame.ravel(), np.arange(0, n * S + 1, S)))
        rows.resize(n, of.F)
        coupled += sparse.diags_array(_per_frame(of, weight[:, c])) - rows.T @ (inverse[:, c, None] * rows)
    return sparse.csc_array(coupled)


def _solved(system: "np.ndarray | sparse.csc_array", gauge: float, level: float, sides: np.ndarray) -> np.ndarray:
    """Solutions [F, m] of a table's equations with damping `level` and a gauge on the sum of its gains."""
    F = len(sides)
    if isinstance(system, np.ndarray):
        return np.linalg.solve(system + gauge + level * np.eye(F), sides)
    from scipy import sparse
    from scipy.sparse.linalg import splu

    # The gauge couples all frames: it follows after the factorisation (Sherman and Morrison 1950).
    factors = splu(sparse.csc_array(system + level * sparse.eye_array(F)), permc_spec="MMD_AT_PLUS_A")
    free, even = factors.solve(sides), factors.solve(np.ones(F))
    return np.asarray(free - np.outer(even, gauge * free.sum(axis=0) / (1 + gauge * even.sum())))
