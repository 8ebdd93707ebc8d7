"""Numba kernels of the EWA projection of 3-D Gaussians to splats (Zwicker et al. 2001), and of its gradient.

With W = J R (J the Jacobian of the pinhole projection at the mean, R the rotation of cam_from_world) and
u, v = the rows of W R_q diag(scales), the 2-D covariance is [[u.u + e, u.v], [u.v, v.v + e]], e = BLUR. Its
determinant is |u x v|^2 + e (u.u + v.v) + e^2 (Lagrange's identity). This is a sum of positive terms, whereas the usual
difference of products loses all digits to cancellation for very elongated splats. The splat's factor (see raster_bins)
follows in closed form. Arithmetic is float64, arrays are float32.
"""

import numpy as np
from numba import njit

from stages.shared.quaternion_kernels import (
    FAST,
    Quaternion,
    Rows,
    Vector,
    rotation,
    rotation_adjoint,
    row,
    unit,
    unit_adjoint,
)
from stages.shared.threads import spread

BLOCK = 1024
"""Gaussians per task; the camera's gradient is summed per block, so it does not depend on the thread count."""
BLUR = 0.3
"""Variance in px^2 added to every splat, as in 3DGS and gsplat ("classic" antialiasing)."""
MARGIN = 0.3
"""J is evaluated inside the field of view widened by this share, as in gsplat: farther out it grows without limit."""
Limits = tuple[float, float, float, float]
"""Small values are tuples, which stay in registers; allocating arrays in the loops would cost more than arithmetic."""


@njit(**FAST)
def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(**FAST)
def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(**FAST)
def _each(a: Vector, b: Vector) -> Vector:
    """Element-wise product."""
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@njit(**FAST)
def _sum(x: float, a: Vector, y: float, b: Vector) -> Vector:
    """x a + y b."""
    return x * a[0] + y * b[0], x * a[1] + y * b[1], x * a[2] + y * b[2]


@njit(**FAST)
def _times(w: Vector, R: Rows) -> Vector:
    """w R."""
    return (
        w[0] * R[0][0] + w[1] * R[1][0] + w[2] * R[2][0],
        w[0] * R[0][1] + w[1] * R[1][1] + w[2] * R[2][1],
        w[0] * R[0][2] + w[1] * R[1][2] + w[2] * R[2][2],
    )


@njit(**FAST)
def _vector(array: np.ndarray, i: int) -> Vector:
    """The first three entries of row i, in float64."""
    return np.float64(array[i, 0]), np.float64(array[i, 1]), np.float64(array[i, 2])


@njit(**FAST)
def _unit_quat(quats: np.ndarray, i: int) -> tuple[Quaternion, float]:
    w, x, y, z = row(quats, i)
    return unit((np.float64(w), np.float64(x), np.float64(y), np.float64(z)))


def _limits(K: np.ndarray, width: int, height: int) -> Limits:
    """Ranges (left, right, top, bottom) of x/z and y/z in which J is evaluated.

    Pixel centres are at integers, so the image spans -0.5 .. width - 0.5.
    """
    left, right = -0.5 - MARGIN * width / 2, width - 0.5 + MARGIN * width / 2
    top, bottom = -0.5 - MARGIN * height / 2, height - 0.5 + MARGIN * height / 2
    fx, fy, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    return (left - cx) / fx, (right - cx) / fx, (top - cy) / fy, (bottom - cy) / fy


@njit(**FAST)
def _to_camera(mean: Vector, viewmat: np.ndarray) -> Vector:
    return (
        viewmat[0, 0] * mean[0] + viewmat[0, 1] * mean[1] + viewmat[0, 2] * mean[2] + viewmat[0, 3],
        viewmat[1, 0] * mean[0] + viewmat[1, 1] * mean[1] + viewmat[1, 2] * mean[2] + viewmat[1, 3],
        viewmat[2, 0] * mean[0] + viewmat[2, 1] * mean[1] + viewmat[2, 2] * mean[2] + viewmat[2, 3],
    )


@njit(**FAST)
def _jacobian(p: Vector, K: np.ndarray, limits: Limits, viewmat: np.ndarray) -> tuple[Vector, Vector]:  # fmt: skip
    """The two rows of W = J R."""
    slope_x = min(max(p[0] / p[2], limits[0]), limits[1])
    slope_y = min(max(p[1] / p[2], limits[2]), limits[3])
    gain_x, gain_y, ahead = K[0, 0] / p[2], K[1, 1] / p[2], _vector(viewmat, 2)
    return (
        _sum(gain_x, _vector(viewmat, 0), -gain_x * slope_x, ahead),
        _sum(gain_y, _vector(viewmat, 1), -gain_y * slope_y, ahead),
    )


@njit(**FAST)
def _covariance(u: Vector, v: Vector) -> tuple[float, float, float, Vector]:
    """Off-diagonal entry, variance along y and determinant of the 2-D covariance, and u x v."""
    normal = _cross(u, v)
    det = _dot(normal, normal) + BLUR * (_dot(u, u) + _dot(v, v)) + BLUR * BLUR
    return _dot(u, v), _dot(v, v) + BLUR, det, normal


def project(means: np.ndarray, quats: np.ndarray, scales: np.ndarray, viewmat: np.ndarray, K: np.ndarray, width: int,
            height: int, near_plane: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Splats of N Gaussians in one camera: centres [N, 2] px, factors [N, 3] 1 / px, z-depths [N] scene units.

    All three are 0 for Gaussians that are not in front of the near plane.

    Args:
        means: [N, 3] scene units. quats: [N, 4] wxyz. scales: [N, 3] scene units. All float32.
        viewmat: cam_from_world [4, 4]. K: [3, 3] px. Both float64. near_plane: scene units.
    """
    N = len(means)
    centres, factors = np.zeros((N, 2), np.float32), np.zeros((N, 3), np.float32)
    depths = np.zeros(N, np.float32)
    inputs = means, quats, scales, viewmat, K, _limits(K, width, height), near_plane
    spread(_project, N, *inputs, centres, factors, depths)
    return centres, factors, depths


@njit(**FAST)
def _project(first: int, last: int, means: np.ndarray, quats: np.ndarray, scales: np.ndarray, viewmat: np.ndarray,
             K: np.ndarray, limits: Limits, near_plane: float, centres: np.ndarray, factors: np.ndarray,
             depths: np.ndarray) -> None:  # fmt: skip
    for i in range(first, last):
        p = _to_camera(_vector(means, i), viewmat)
        if p[2] <= near_plane:
            continue
        R, scale = rotation(_unit_quat(quats, i)[0]), _vector(scales, i)
        W = _jacobian(p, K, limits, viewmat)
        b, c, det, _ = _covariance(_each(_times(W[0], R), scale), _each(_times(W[1], R), scale))
        centres[i, 0] = K[0, 0] * p[0] / p[2] + K[0, 2]
        centres[i, 1] = K[1, 1] * p[1] / p[2] + K[1, 2]
        f0 = np.sqrt(c / (2 * det))
        factors[i, 0], factors[i, 1], factors[i, 2] = f0, -b / c * f0, 1 / np.sqrt(2 * c)
        depths[i] = p[2]


@njit(**FAST)
def _axes_adjoint(u: Vector, v: Vector, f: Vector, g: Vector) -> tuple[Vector, Vector]:
    """Gradients of u and v from the gradient g of the factor f, through (b, c, det)."""
    _, c, det, normal = _covariance(u, v)
    g_b = -g[1] / np.sqrt(2 * c * det)
    g_c = (g[0] * f[0] - g[1] * f[1] - g[2] * f[2]) / (2 * c)
    g_det = -(g[0] * f[0] + g[1] * f[1]) / (2 * det)
    g_u = _sum(2 * g_det, _cross(v, normal), 2 * g_det * BLUR, u)
    g_v = _sum(2 * g_det, _cross(normal, u), 2 * g_det * BLUR + 2 * g_c, v)
    return _sum(1.0, g_u, g_b, v), _sum(1.0, g_v, g_b, u)


@njit(**FAST)
def _camera_adjoint(mean: Vector, p: Vector, K: np.ndarray, limits: Limits, viewmat: np.ndarray,
                    g_W: tuple[Vector, Vector], g_centre: tuple[float, float], g_depth: float, posed: bool,
                    g_view: np.ndarray) -> Vector:  # fmt: skip
    """Gradient of the camera-space mean p from those of W, centre and depth.

    If `posed`, adds that of viewmat to g_view [4, 4].
    """
    g0, g1 = g_centre[0] * K[0, 0] / p[2], g_centre[1] * K[1, 1] / p[2]
    g2 = g_depth - (g0 * p[0] + g1 * p[1]) / p[2]
    for r in range(2):
        raw, g_row = (p[0], p[1])[r] / p[2], g_W[r]
        slope, gain = min(max(raw, limits[2 * r]), limits[2 * r + 1]), K[r, r] / p[2]
        along, across = _dot(g_row, _vector(viewmat, r)), _dot(g_row, _vector(viewmat, 2))
        g2 -= gain / p[2] * (along - slope * across)
        if raw == slope:
            g_slope = -gain * across / p[2]
            g0, g1 = (g0 + g_slope, g1) if r == 0 else (g0, g1 + g_slope)
            g2 -= g_slope * raw
        if posed:
            for k in range(3):
                g_view[r, k] += gain * g_row[k]
                g_view[2, k] -= gain * slope * g_row[k]
    if posed:
        for r in range(3):
            g = (g0, g1, g2)[r]
            for k in range(3):
                g_view[r, k] += g * mean[k]
            g_view[r, 3] += g
    return g0, g1, g2


def project_adjoint(means: np.ndarray, quats: np.ndarray, scales: np.ndarray, viewmat: np.ndarray, K: np.ndarray,
                    width: int, height: int, factors: np.ndarray, depths: np.ndarray, g_centres: np.ndarray,
                    g_factors: np.ndarray, g_depths: np.ndarray, posed: bool
                    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Gradients of means [N, 3], quats [N, 4], scales [N, 3] and viewmat [4, 4] from those of what `project` returned.

    That of viewmat is zero unless `posed`: most trainings leave the poses as they are.

    Args:
        factors: [N, 3] and depths: [N], as `project` returned them.
        g_centres: [N, 2]. g_factors: [N, 3]. g_depths: [N].
    """
    N = len(means)
    g_means, g_quats = np.zeros((N, 3), np.float32), np.zeros((N, 4), np.float32)
    g_scales = np.zeros((N, 3), np.float32)
    g_views = np.zeros(((N + BLOCK - 1) // BLOCK, 4, 4))
    camera, gradients = (viewmat, K, _limits(K, width, height)), (g_centres, g_factors, g_depths)
    inputs = means, quats, scales, *camera, factors, depths, *gradients
    spread(_project_adjoint, len(g_views), *inputs, posed, g_means, g_quats, g_scales, g_views)
    return g_means, g_quats, g_scales, g_views.sum(axis=0)


@njit(**FAST)
def _project_adjoint(first: int, last: int, means: np.ndarray, quats: np.ndarray, scales: np.ndarray,
                     viewmat: np.ndarray, K: np.ndarray, limits: Limits, factors: np.ndarray, depths: np.ndarray,
                     g_centres: np.ndarray, g_factors: np.ndarray, g_depths: np.ndarray, posed: bool,
                     g_means: np.ndarray, g_quats: np.ndarray, g_scales: np.ndarray,
                     g_views: np.ndarray) -> None:  # fmt: skip
    N = len(means)
    for block in range(first, last):
        g_view = g_views[block]
        for i in range(block * BLOCK, min(N, (block + 1) * BLOCK)):
            moves = g_centres[i, 0] != 0 or g_centres[i, 1] != 0 or g_depths[i] != 0
            shapes = g_factors[i, 0] != 0 or g_factors[i, 1] != 0 or g_factors[i, 2] != 0
            if depths[i] == 0 or not (moves or shapes):  # beside the image, or hidden: a quarter of those in front
                continue
            mean, scale = _vector(means, i), _vector(scales, i)
            p = _to_camera(mean, viewmat)
            quat, length = _unit_quat(quats, i)
            R, W = rotation(quat), _jacobian(p, K, limits, viewmat)
            B = _times(W[0], R), _times(W[1], R)
            g_u, g_v = _axes_adjoint(_each(B[0], scale), _each(B[1], scale), _vector(factors, i), _vector(g_factors, i))
            g_scales[i, 0] = g_u[0] * B[0][0] + g_v[0] * B[1][0]
            g_scales[i, 1] = g_u[1] * B[0][1] + g_v[1] * B[1][1]
            g_scales[i, 2] = g_u[2] * B[0][2] + g_v[2] * B[1][2]
            g_u, g_v = _each(g_u, scale), _each(g_v, scale)
            g_R = (_sum(W[0][0], g_u, W[1][0], g_v), _sum(W[0][1], g_u, W[1][1], g_v), _sum(W[0][2], g_u, W[1][2], g_v))
            g_quat = unit_adjoint(quat, length, rotation_adjoint(quat, g_R))
            g_quats[i, 0], g_quats[i, 1], g_quats[i, 2], g_quats[i, 3] = g_quat
            g_W = (
                (_dot(g_u, R[0]), _dot(g_u, R[1]), _dot(g_u, R[2])),
                (_dot(g_v, R[0]), _dot(g_v, R[1]), _dot(g_v, R[2])),
            )
            g_centre = np.float64(g_centres[i, 0]), np.float64(g_centres[i, 1])
            g_p = _camera_adjoint(mean, p, K, limits, viewmat, g_W, g_centre, g_depths[i], posed, g_view)
            g_means[i, 0], g_means[i, 1], g_means[i, 2] = _times(
                g_p, (_vector(viewmat, 0), _vector(viewmat, 1), _vector(viewmat, 2))
            )
