"""SO(3) and SE(3) in float64, numerically stable at angles 0 and pi; tangent vectors are [translation, rotation]."""

import numpy as np


def skew(v: np.ndarray) -> np.ndarray:
    """Cross-product matrices [..., 3, 3] of vectors [..., 3]."""
    v = np.asarray(v, float)
    x, y, z, W = v[..., 0], v[..., 1], v[..., 2], np.zeros((*v.shape, 3))
    W[..., 2, 1], W[..., 0, 2], W[..., 1, 0] = x, y, z
    W[..., 1, 2], W[..., 2, 0], W[..., 0, 1] = -x, -y, -z
    return W


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products [..., 3] of vectors [..., 3]; several times as fast as that of numpy where they are few."""
    (ax, ay, az), (bx, by, bz) = ((v[..., 0], v[..., 1], v[..., 2]) for v in (a, b))
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def exp_so3(omega: np.ndarray) -> np.ndarray:
    """Rotation matrices [..., 3, 3] of rotation vectors [..., 3] in radians."""
    omega = np.asarray(omega, float)
    half = np.linalg.norm(omega, axis=-1, keepdims=True) / 2
    return matrix_from_quat(np.concatenate([np.cos(half), np.sinc(half / np.pi) * omega / 2], axis=-1))


def log_so3(R: np.ndarray) -> np.ndarray:
    """Rotation vectors [..., 3] in radians, of length 0..pi, of rotation matrices [..., 3, 3]."""
    quat = quat_from_matrix(R)
    w, v = quat[..., :1], quat[..., 1:]
    sine = np.linalg.norm(v, axis=-1, keepdims=True)
    half = np.arctan2(sine, w)
    return np.asarray(2 * v / np.sinc(half / np.pi))


def exp_se3(xi: np.ndarray) -> np.ndarray:
    """Rigid motions [..., 4, 4] of twists [..., 6] = [rho, omega].

    t = V rho with V = I + b [w]x + c [w]x^2, b = (1 - cos a) / a^2, c = (a - sin a) / a^3 (series near a = 0).
    """
    xi = np.asarray(xi, float)
    rho, omega = xi[..., :3], xi[..., 3:]
    angle = np.linalg.norm(omega, axis=-1)
    b, c = _one_minus_cos(angle), _angle_minus_sin(angle)
    W = skew(omega)
    V = np.eye(3) + b[..., None, None] * W + c[..., None, None] * (W @ W)
    return from_parts(exp_so3(omega), np.einsum("...ij,...j->...i", V, rho))


def log_se3(T: np.ndarray) -> np.ndarray:
    """Twists [..., 6] of rigid motions [..., 4, 4]; inverse of `exp_se3` for angles up to pi.

    V^-1 = I - [w]x / 2 + k [w]x^2 with k = (1 - (a / 2) cot(a / 2)) / a^2 (series near a = 0).
    """
    T = np.asarray(T, float)
    omega = log_so3(T[..., :3, :3])
    angle = np.linalg.norm(omega, axis=-1)
    small = angle < 1e-2
    half = np.where(small, 1.0, angle) / 2
    exact = (1 - half / np.tan(half)) / (2 * half) ** 2
    k = np.where(small, 1 / 12 + angle**2 / 720 + angle**4 / 30240, exact)
    W = skew(omega)
    V_inv = np.eye(3) - W / 2 + k[..., None, None] * (W @ W)
    return np.concatenate([np.einsum("...ij,...j->...i", V_inv, T[..., :3, 3]), omega], axis=-1)


def adjoint(T: np.ndarray) -> np.ndarray:
    """Adjoints [..., 6, 6] of rigid motions [..., 4, 4]: T exp(xi) T^-1 = exp(Ad(T) xi)."""
    R, t = T[..., :3, :3], T[..., :3, 3]
    Ad = np.zeros((*T.shape[:-2], 6, 6))
    Ad[..., :3, :3] = Ad[..., 3:, 3:] = R
    Ad[..., :3, 3:] = skew(t) @ R
    return Ad


def inverse(T: np.ndarray) -> np.ndarray:
    """Inverses of rigid motions [..., 4, 4]."""
    R_inv = np.swapaxes(T[..., :3, :3], -1, -2)
    return from_parts(R_inv, -np.einsum("...ij,...j->...i", R_inv, T[..., :3, 3]))


def from_parts(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Rigid motions [..., 4, 4] from rotations [..., 3, 3] and translations [..., 3]."""
    T = np.zeros((*R.shape[:-2], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def quat_from_matrix(R: np.ndarray) -> np.ndarray:
    """Unit quaternions wxyz [..., 4], w >= 0, of rotation matrices [..., 3, 3].

    The matrix 4 q q^T - I is linear in R. The column of 4 q q^T with the largest component of q is free of cancellation
    (Shepperd, J. Guidance and Control 1978).
    """
    R = np.asarray(R, float)
    xx, yy, zz = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    squared = np.stack([xx + yy + zz, xx - yy - zz, yy - xx - zz, zz - xx - yy], axis=-1)
    outer = np.zeros((*R.shape[:-2], 4, 4))
    outer[..., range(4), range(4)] = 1 + squared
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        outer[..., 0, k + 1] = outer[..., k + 1, 0] = R[..., j, i] - R[..., i, j]
        outer[..., i + 1, j + 1] = outer[..., j + 1, i + 1] = R[..., i, j] + R[..., j, i]
    largest = squared.argmax(axis=-1)[..., None, None]
    quat = np.take_along_axis(outer, largest, axis=-1)[..., 0]
    return np.asarray(quat / np.linalg.norm(quat, axis=-1, keepdims=True) * np.where(quat[..., :1] < 0, -1, 1))


def matrix_from_quat(quat: np.ndarray) -> np.ndarray:
    """Rotation matrices [..., 3, 3] of quaternions wxyz [..., 4], which are normalised here.

    Raises:
        ValueError: for a quaternion of length zero.
    """
    quat = np.asarray(quat, float)
    largest = np.abs(quat).max(axis=-1, keepdims=True)
    if (largest == 0).any():
        raise ValueError("a quaternion of length zero is no rotation")
    quat = quat / largest  # the squares of tiny entries would underflow
    V = skew(quat[..., 1:])
    w, squared = quat[..., :1, None], (quat**2).sum(axis=-1)[..., None, None]
    return np.asarray(np.eye(3) + 2 / squared * (w * V + V @ V))


def _one_minus_cos(angle: np.ndarray) -> np.ndarray:
    """(1 - cos a) / a^2 = sinc(a / 2)^2 / 2, without cancellation."""
    return 0.5 * np.sinc(angle / (2 * np.pi)) ** 2


def _angle_minus_sin(angle: np.ndarray) -> np.ndarray:
    """(a - sin a) / a^3."""
    small = angle < 1e-1
    safe = np.where(small, 1.0, angle)
    series = 1 / 6 - angle**2 / 120 + angle**4 / 5040 - angle**6 / 362880
    return np.where(small, series, (safe - np.sin(safe)) / safe**3)
