"""Numba kernels of linear blend skinning: blend K rigid motions per Gaussian, and the adjoint."""

import numpy as np
from numba import njit, prange

CHUNKS = 16
"""Partial sums of the scatter into control points: a fixed number, so results do not depend on the thread count."""


@njit(cache=True, inline="always")
def _product(a: np.ndarray, b: np.ndarray, out: np.ndarray) -> None:
    out[0] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3]
    out[1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2]
    out[2] = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1]
    out[3] = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0]


@njit(cache=True, inline="always")
def _unit(q: np.ndarray, out: np.ndarray) -> float:
    """q / |q| into `out`, scaled by the largest entry first against underflow; returns |q|. Zero stays zero."""
    largest = max(abs(q[0]), abs(q[1]), abs(q[2]), abs(q[3]))
    if largest == 0:
        out[:] = 0
        return 1.0
    for c in range(4):
        out[c] = q[c] / largest
    length = np.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2] + out[3] * out[3])
    for c in range(4):
        out[c] /= length
    return largest * length


@njit(cache=True, inline="always")
def _blended(
    point_quats: np.ndarray, weights: np.ndarray, index: np.ndarray, signs: np.ndarray, out: np.ndarray
) -> None:
    """Sign-aligned weighted sum of the neighbours' quaternions of one Gaussian."""
    K = len(index)
    heaviest = 0
    for k in range(1, K):
        if weights[k] > weights[heaviest]:
            heaviest = k
    reference = point_quats[index[heaviest]]
    out[:] = 0
    for k in range(K):
        r = point_quats[index[k]]
        cosine = r[0] * reference[0] + r[1] * reference[1] + r[2] * reference[2] + r[3] * reference[3]
        signs[k] = -1 if cosine < 0 else 1
        for c in range(4):
            out[c] += signs[k] * weights[k] * r[c]


@njit(cache=True, parallel=True)
def forward(
    means: np.ndarray,
    quats: np.ndarray,
    rotations: np.ndarray,
    points: np.ndarray,
    moved_points: np.ndarray,
    point_quats: np.ndarray,
    weights: np.ndarray,
    index: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """means' [N, 3] and unit quats' [N, 4]; arguments as in `lbs.blend`, rotations [P, 3, 3], moved_points = p + T."""
    N, K = index.shape
    moved = np.empty_like(means)
    turned = np.empty_like(quats)
    for chunk in prange(CHUNKS):
        signs = np.empty(K, means.dtype)
        blended, unit_blended, unit = np.empty(4, means.dtype), np.empty(4, means.dtype), np.empty(4, means.dtype)
        for n in range(chunk * N // CHUNKS, (chunk + 1) * N // CHUNKS):
            for a in range(3):
                total = means.dtype.type(0)
                for k in range(K):
                    m = index[n, k]
                    value = moved_points[m, a]
                    for b in range(3):
                        value += rotations[m, a, b] * (means[n, b] - points[m, b])
                    total += weights[n, k] * value
                moved[n, a] = total
            _blended(point_quats, weights[n], index[n], signs, blended)
            _unit(blended, unit_blended)
            _unit(quats[n], unit)
            _product(unit_blended, unit, turned[n])
    return moved, turned


@njit(cache=True, parallel=True)
def backward(
    means: np.ndarray,
    quats: np.ndarray,
    rotations: np.ndarray,
    points: np.ndarray,
    moved_points: np.ndarray,
    point_quats: np.ndarray,
    weights: np.ndarray,
    index: np.ndarray,
    g_moved: np.ndarray,
    g_turned: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gradients of the first seven arguments of `forward`, given those of its results [N, 3] and [N, 4]."""
    N, K = index.shape
    g_means, g_quats, g_weights = np.empty_like(means), np.empty_like(quats), np.empty_like(weights)
    # Per chunk and control point: rotation 0:9, point 9:12, moved point 12:15, quaternion 15:19.
    scattered = np.zeros((CHUNKS, len(points), 19), means.dtype)
    for chunk in prange(CHUNKS):
        signs, g_blended = np.empty(K, means.dtype), np.empty(4, means.dtype)
        for n in range(chunk * N // CHUNKS, (chunk + 1) * N // CHUNKS):
            _position_adjoint(
                n, means, rotations, points, moved_points, weights, index,
                g_moved, g_means, g_weights, scattered[chunk],
            )  # fmt: skip
            _rotation_adjoint(quats[n], point_quats, weights[n], index[n], signs, g_turned[n], g_quats[n], g_blended)
            for k in range(K):
                r, into = point_quats[index[n, k]], scattered[chunk, index[n, k]]
                for c in range(4):
                    g_weights[n, k] += signs[k] * r[c] * g_blended[c]
                    into[15 + c] += signs[k] * weights[n, k] * g_blended[c]
    total = scattered.sum(axis=0)
    g_rotations = np.ascontiguousarray(total[:, :9]).reshape(-1, 3, 3)
    return g_means, g_quats, g_rotations, total[:, 9:12].copy(), total[:, 12:15].copy(), total[:, 15:].copy(), g_weights


@njit(cache=True, inline="always")
def _position_adjoint(
    n: int,
    means: np.ndarray,
    rotations: np.ndarray,
    points: np.ndarray,
    moved_points: np.ndarray,
    weights: np.ndarray,
    index: np.ndarray,
    g_moved: np.ndarray,
    g_means: np.ndarray,
    g_weights: np.ndarray,
    scattered: np.ndarray,
) -> None:
    """Adjoint of mu' = sum_k w_k (R_k (mu - p_k) + p_k + T_k) for one Gaussian; sets its rows, adds to `scattered`."""
    g_means[n] = 0
    for k in range(index.shape[1]):
        m, w = index[n, k], weights[n, k]
        into = scattered[m]
        g_weight = 0.0
        for a in range(3):
            value = moved_points[m, a]
            for b in range(3):
                local = means[n, b] - points[m, b]
                value += rotations[m, a, b] * local
                pulled_back = w * rotations[m, a, b] * g_moved[n, a]
                into[3 * a + b] += w * g_moved[n, a] * local
                into[9 + b] -= pulled_back
                g_means[n, b] += pulled_back
            into[12 + a] += w * g_moved[n, a]
            g_weight += g_moved[n, a] * value
        g_weights[n, k] = g_weight


@njit(cache=True, inline="always")
def _rotation_adjoint(
    quat: np.ndarray,
    point_quats: np.ndarray,
    weights: np.ndarray,
    index: np.ndarray,
    signs: np.ndarray,
    g_turned: np.ndarray,
    g_quat: np.ndarray,
    g_blended: np.ndarray,
) -> None:
    """Adjoint of q' = unit(blend) x unit(q) for one Gaussian; fills `signs`, `g_quat` and `g_blended`."""
    blended, unit_blended, unit = np.empty(4, quat.dtype), np.empty(4, quat.dtype), np.empty(4, quat.dtype)
    _blended(point_quats, weights, index, signs, blended)
    blended_length, length = _unit(blended, unit_blended), _unit(quat, unit)
    for c in range(1, 4):  # conjugates: the adjoint of a x b in a is g x conj(b), in b it is conj(a) x g
        unit_blended[c] *= -1
        unit[c] *= -1
    _product(g_turned, unit, g_blended)
    _product(unit_blended, g_turned, g_quat)
    for c in range(1, 4):
        unit_blended[c] *= -1
        unit[c] *= -1
    along_blended = (unit_blended * g_blended).sum()
    along = (unit * g_quat).sum()
    for c in range(4):  # the adjoint of u / |u| is (g - u <u, g>) / |u|
        g_blended[c] = (g_blended[c] - unit_blended[c] * along_blended) / blended_length
        g_quat[c] = (g_quat[c] - unit[c] * along) / length
