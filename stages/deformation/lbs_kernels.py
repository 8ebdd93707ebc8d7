"""Numba kernels of linear blend skinning: the blend of K rigid motions per Gaussian, and its adjoint.

The motion of a control point is one row of 16 numbers: of x -> R x + t, with x counted from the mean of the control
points, the rotation 0:9 and t 9:12, then the quaternion 12:16. So a blend is K weighted sums of rows, and the adjoint
adds K weighted rows: each row is one vector.
"""

import numpy as np
from numba import njit

from stages.deformation.weight_kernels import CHUNKS
from stages.shared.lanes import LANES, load, store, total
from stages.shared.quaternion_kernels import (
    FAST,
    Quaternion,
    conjugate,
    product,
    rotation,
    rotation_adjoint,
    row,
    unit,
    unit_adjoint,
)
from stages.shared.threads import spread


@njit(**FAST)
def _pack(points: np.ndarray, point_quats: np.ndarray, point_translations: np.ndarray, centre: np.ndarray,
          packed: np.ndarray) -> None:  # fmt: skip
    """Fill the motions [P, 16]."""
    for p in range(len(points)):
        quat = row(point_quats, p)
        rows = rotation(quat)
        packed[p, 0], packed[p, 1], packed[p, 2] = rows[0]
        packed[p, 3], packed[p, 4], packed[p, 5] = rows[1]
        packed[p, 6], packed[p, 7], packed[p, 8] = rows[2]
        for a in range(3):
            packed[p, 9 + a] = points[p, a] + point_translations[p, a]
            for b in range(3):
                packed[p, 9 + a] -= packed[p, 3 * a + b] * (points[p, b] - centre[b])
        packed[p, 12], packed[p, 13], packed[p, 14], packed[p, 15] = quat


@njit(inline="always", **FAST)
def _quat(motion: np.ndarray) -> Quaternion:
    return motion[12], motion[13], motion[14], motion[15]


@njit(**FAST)
def _unpack_adjoint(points: np.ndarray, packed: np.ndarray, centre: np.ndarray, summed: np.ndarray,
                    g_points: np.ndarray, g_quats: np.ndarray, g_translations: np.ndarray) -> None:  # fmt: skip
    """Fill the gradients of p, quaternion and T of each control point, from those of the motions [P, 16].

    The gradient of p through t is that of t minus R^T times it.
    """
    for p in range(len(packed)):
        g = summed[p]
        for a in range(3):
            turned = packed[p, a] * g[9] + packed[p, 3 + a] * g[10] + packed[p, 6 + a] * g[11]
            g_points[p, a], g_translations[p, a] = g[9 + a] - turned, g[9 + a]
            for b in range(3):
                g[3 * a + b] -= g[9 + a] * (points[p, b] - centre[b])
        g_rows = (g[0], g[1], g[2]), (g[3], g[4], g[5]), (g[6], g[7], g[8])
        g_w, g_x, g_y, g_z = rotation_adjoint(_quat(packed[p]), g_rows)
        g_quats[p, 0], g_quats[p, 1] = g[12] + g_w, g[13] + g_x
        g_quats[p, 2], g_quats[p, 3] = g[14] + g_y, g[15] + g_z


@njit(inline="always", **FAST)
def _heaviest(weights: np.ndarray, index: np.ndarray, n: int) -> int:
    """The heaviest control point of Gaussian n, to whose quaternion the others' signs are aligned."""
    best = 0
    for k in range(1, index.shape[1]):
        if weights[n, k] > weights[n, best]:
            best = k
    return int(index[n, best])


def _signs(dtype: np.dtype) -> np.ndarray:
    """Factors of a motion [2, 16]: all one, and with the quaternion's turned."""
    signs = np.ones((2, LANES), dtype)
    signs[1, 12:] = -1
    return signs


@njit(inline="always", **FAST)
def _flips(packed: np.ndarray, p: int, reference: int) -> int:
    """1 if the quaternion of p counts with the opposite sign, else 0."""
    along = packed[p, 12] * packed[reference, 12] + packed[p, 13] * packed[reference, 13]
    return int(along + packed[p, 14] * packed[reference, 14] + packed[p, 15] * packed[reference, 15] < 0)


@njit(inline="always", **FAST)
def _blended(packed: np.ndarray, signs: np.ndarray, weights: np.ndarray, index: np.ndarray, n: int,
             motion: np.ndarray) -> int:  # fmt: skip
    """Sum the motions of Gaussian n into `motion` [16]; returns its heaviest control point."""
    reference = _heaviest(weights, index, n)
    blended = load(signs, 0) * weights.dtype.type(0)
    for k in range(index.shape[1]):
        p = index[n, k]
        blended = blended + load(packed, LANES * p) * load(signs, LANES * _flips(packed, p, reference)) * weights[n, k]
    store(motion, 0, blended)
    return reference


def blend(
    means: np.ndarray,
    quats: np.ndarray,
    points: np.ndarray,
    point_quats: np.ndarray,
    point_translations: np.ndarray,
    weights: np.ndarray,
    index: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """means' [N, 3] and unit quats' [N, 4]; arguments as in `lbs.blend`."""
    packed, centre = _motions(points, point_quats, point_translations)
    moved, turned = np.empty_like(means), np.empty_like(quats)
    spread(_blend, len(index), means, quats, packed, _signs(points.dtype), centre, weights, index, moved, turned)
    return moved, turned


def _motions(points: np.ndarray, quats: np.ndarray, translations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The motions [P, 16] of the control points, and the centre [3] that they refer to."""
    centre = points.sum(axis=0) / points.dtype.type(len(points))
    packed = np.empty((len(points), LANES), points.dtype)
    _pack(points, quats, translations, centre, packed)
    return packed, centre


@njit(**FAST)
def _blend(first: int, last: int, means: np.ndarray, quats: np.ndarray, packed: np.ndarray, signs: np.ndarray,
           centre: np.ndarray, weights: np.ndarray, index: np.ndarray, moved: np.ndarray,
           turned: np.ndarray) -> None:  # fmt: skip
    motion = np.empty(16, packed.dtype)
    for n in range(first, last):
        _blended(packed, signs, weights, index, n, motion)
        x, y, z = means[n, 0] - centre[0], means[n, 1] - centre[1], means[n, 2] - centre[2]
        moved[n, 0] = motion[9] + motion[0] * x + motion[1] * y + motion[2] * z
        moved[n, 1] = motion[10] + motion[3] * x + motion[4] * y + motion[5] * z
        moved[n, 2] = motion[11] + motion[6] * x + motion[7] * y + motion[8] * z
        blended, _ = unit(_quat(motion))
        own, _ = unit(row(quats, n))
        turned[n, 0], turned[n, 1], turned[n, 2], turned[n, 3] = product(blended, own)


def blend_adjoint(
    means: np.ndarray,
    quats: np.ndarray,
    points: np.ndarray,
    point_quats: np.ndarray,
    point_translations: np.ndarray,
    weights: np.ndarray,
    index: np.ndarray,
    g_moved: np.ndarray,
    g_turned: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gradients of the first six arguments of `blend`, given those of its results [N, 3] and [N, 4]."""
    packed, centre = _motions(points, point_quats, point_translations)
    g_means, g_quats, g_weights = np.empty_like(means), np.empty_like(quats), np.empty_like(weights)
    scattered = np.zeros((CHUNKS, len(points), LANES), means.dtype)
    given = means, quats, packed, _signs(points.dtype), centre, weights, index, g_moved, g_turned
    spread(_blend_adjoint, CHUNKS, *given, g_means, g_quats, g_weights, scattered)
    g_points, g_point_quats, g_translations = (np.empty_like(part) for part in (points, point_quats, points))
    _unpack_adjoint(points, packed, centre, scattered.sum(axis=0), g_points, g_point_quats, g_translations)
    return g_means, g_quats, g_points, g_point_quats, g_translations, g_weights


@njit(**FAST)
def _blend_adjoint(first: int, last: int, means: np.ndarray, quats: np.ndarray, packed: np.ndarray, signs: np.ndarray,
                   centre: np.ndarray, weights: np.ndarray, index: np.ndarray, g_moved: np.ndarray,
                   g_turned: np.ndarray, g_means: np.ndarray, g_quats: np.ndarray, g_weights: np.ndarray,
                   scattered: np.ndarray) -> None:  # fmt: skip
    N, P = len(index), len(packed)
    motion, g_motion = np.empty(16, packed.dtype), np.empty(16, packed.dtype)
    for chunk in range(first, last):
        for n in range(chunk * N // CHUNKS, (chunk + 1) * N // CHUNKS):
            reference = _blended(packed, signs, weights, index, n, motion)
            for a in range(3):
                g_means[n, a] = (
                    motion[a] * g_moved[n, 0] + motion[3 + a] * g_moved[n, 1] + motion[6 + a] * g_moved[n, 2]
                )
                g_motion[9 + a] = g_moved[n, a]
                for b in range(3):
                    g_motion[3 * a + b] = g_moved[n, a] * (means[n, b] - centre[b])
            blended, length = unit(_quat(motion))
            own, own_length = unit(row(quats, n))
            g_unit = row(g_turned, n)  # the adjoint of a x b is g x conj(b) in a, and conj(a) x g in b
            g_quat = unit_adjoint(own, own_length, product(conjugate(blended), g_unit))
            g_quats[n, 0], g_quats[n, 1], g_quats[n, 2], g_quats[n, 3] = g_quat
            g_blended = unit_adjoint(blended, length, product(g_unit, conjugate(own)))
            g_motion[12], g_motion[13], g_motion[14], g_motion[15] = g_blended
            g = load(g_motion, 0)
            for k in range(index.shape[1]):
                p = index[n, k]
                signed, at = g * load(signs, LANES * _flips(packed, p, reference)), LANES * (chunk * P + p)
                g_weights[n, k] = total(load(packed, LANES * p) * signed)
                store(scattered, at, load(scattered, at) + signed * weights[n, k])
