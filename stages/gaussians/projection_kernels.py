"""Numba kernels of the EWA projection of 3-D Gaussians to splats (Zwicker et al. 2001), and the adjoint.

With W = J R (J the Jacobian of the pinhole projection at the mean, R the rotation of cam_from_world) and
u, v = the rows of W R_q diag(scales), the 2-D covariance is [[u.u + e, u.v], [u.v, v.v + e]], e = BLUR. Its
determinant is |u x v|^2 + e (u.u + v.v) + e^2 (Lagrange's identity): a sum of positive terms, where a d - b^2 would
cancel for needles. The splat's factor (see raster_kernels) follows in closed form. What concerns one Gaussian is
computed in float64; memory is float32.
"""

import numpy as np
from numba import njit, prange

BLOCK = 1024
"""Gaussians per task; the camera's gradient is summed per block, so it does not depend on the thread count."""
BLUR = 0.3
"""Variance in px^2 added to every splat, as in 3DGS and gsplat ("classic" antialiasing)."""
MARGIN = 0.3
"""J is evaluated inside the field of view widened by this share: beyond, the linearisation explodes (as in gsplat)."""
EXACT = {"cache": True, "error_model": "numpy"}


@njit(**EXACT)
def _rotation(quat: np.ndarray, R: np.ndarray) -> float:
    """Rotation matrix [3, 3] of a quaternion wxyz into R; returns its length. Scaled first against underflow."""
    largest = np.float64(max(abs(quat[0]), abs(quat[1]), abs(quat[2]), abs(quat[3])))
    w, x, y, z = quat[0] / largest, quat[1] / largest, quat[2] / largest, quat[3] / largest
    length = np.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / length, x / length, y / length, z / length
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return largest * length


@njit(**EXACT)
def _quat_adjoint(quat: np.ndarray, length: float, g: np.ndarray, out: np.ndarray) -> None:
    """Gradient of the (unnormalised) quaternion, of this length, from that of its rotation matrix."""
    w, x, y, z = quat[0] / length, quat[1] / length, quat[2] / length, quat[3] / length
    gw = 2 * (x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1]))
    a, b, c = g[0, 1] + g[1, 0], g[0, 2] + g[2, 0], g[1, 2] + g[2, 1]
    gx = 2 * (y * a + z * b + w * (g[2, 1] - g[1, 2]) - 2 * x * (g[1, 1] + g[2, 2]))
    gy = 2 * (x * a + z * c + w * (g[0, 2] - g[2, 0]) - 2 * y * (g[0, 0] + g[2, 2]))
    gz = 2 * (x * b + y * c + w * (g[1, 0] - g[0, 1]) - 2 * z * (g[0, 0] + g[1, 1]))
    radial = w * gw + x * gx + y * gy + z * gz
    out[0], out[1] = (gw - radial * w) / length, (gx - radial * x) / length
    out[2], out[3] = (gy - radial * y) / length, (gz - radial * z) / length


@njit(**EXACT)
def _limits(K: np.ndarray, width: int, height: int) -> tuple[float, float, float, float]:
    """Range of x/z and of y/z where J is evaluated; pixel centres at integers: the image spans -0.5 .. width - 0.5."""
    left, right = (
        (-0.5 - MARGIN * width / 2 - K[0, 2]) / K[0, 0],
        (width - 0.5 + MARGIN * width / 2 - K[0, 2]) / K[0, 0],
    )
    top, bottom = (
        (-0.5 - MARGIN * height / 2 - K[1, 2]) / K[1, 1],
        (height - 0.5 + MARGIN * height / 2 - K[1, 2]) / K[1, 1],
    )
    return left, right, top, bottom


@njit(**EXACT)
def _to_camera(mean: np.ndarray, viewmat: np.ndarray, p: np.ndarray) -> None:
    for a in range(3):
        p[a] = viewmat[a, 0] * mean[0] + viewmat[a, 1] * mean[1] + viewmat[a, 2] * mean[2] + viewmat[a, 3]


@njit(**EXACT)
def _screen_axes(p: np.ndarray, K: np.ndarray, limits: tuple[float, float, float, float], viewmat: np.ndarray,
                 R: np.ndarray, scales: np.ndarray, W: np.ndarray, B: np.ndarray, uv: np.ndarray) -> None:  # fmt: skip
    """W = J R [2, 3], B = W R_q and uv = B diag(scales), whose rows are u and v."""
    slope_x = min(max(p[0] / p[2], limits[0]), limits[1])
    slope_y = min(max(p[1] / p[2], limits[2]), limits[3])
    for c in range(3):
        W[0, c] = K[0, 0] / p[2] * (viewmat[0, c] - slope_x * viewmat[2, c])
        W[1, c] = K[1, 1] / p[2] * (viewmat[1, c] - slope_y * viewmat[2, c])
    for r in range(2):
        for c in range(3):
            B[r, c] = W[r, 0] * R[0, c] + W[r, 1] * R[1, c] + W[r, 2] * R[2, c]
            uv[r, c] = B[r, c] * scales[c]


@njit(**EXACT)
def _cross(a: np.ndarray, b: np.ndarray, out: np.ndarray) -> None:
    out[0], out[1], out[2] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(**EXACT)
def _dot(a: np.ndarray, b: np.ndarray) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(**EXACT)
def _covariance(uv: np.ndarray, normal: np.ndarray) -> tuple[float, float, float]:
    """Off-diagonal, vertical variance and determinant of the 2-D covariance; u x v goes to `normal`."""
    _cross(uv[0], uv[1], normal)
    uu, vv = _dot(uv[0], uv[0]), _dot(uv[1], uv[1])
    return _dot(uv[0], uv[1]), vv + BLUR, _dot(normal, normal) + BLUR * (uu + vv) + BLUR * BLUR


@njit(parallel=True, **EXACT)
def project(means: np.ndarray, quats: np.ndarray, scales: np.ndarray, viewmat: np.ndarray, K: np.ndarray, width: int,
            height: int, near_plane: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Centres [N, 2] px, factors [N, 3], depths [N]; depth 0 (and centre, factor 0) marks what is not in front."""
    N = len(means)
    centres, factors = np.zeros((N, 2), np.float32), np.zeros((N, 3), np.float32)
    depths = np.zeros(N, np.float32)
    limits = _limits(K, width, height)
    for block in prange((N + BLOCK - 1) // BLOCK):
        p, normal, R = np.empty(3), np.empty(3), np.empty((3, 3))
        W, B, uv = np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3))
        for i in range(block * BLOCK, min(N, (block + 1) * BLOCK)):
            _to_camera(means[i], viewmat, p)
            if p[2] <= near_plane:
                continue
            _rotation(quats[i], R)
            _screen_axes(p, K, limits, viewmat, R, scales[i], W, B, uv)
            b, c, det = _covariance(uv, normal)
            centres[i, 0] = K[0, 0] * p[0] / p[2] + K[0, 2]
            centres[i, 1] = K[1, 1] * p[1] / p[2] + K[1, 2]
            f0 = np.sqrt(c / (2 * det))
            factors[i, 0], factors[i, 1], factors[i, 2] = f0, -b / c * f0, 1 / np.sqrt(2 * c)
            depths[i] = p[2]
    return centres, factors, depths


@njit(**EXACT)
def _axes_adjoint(uv: np.ndarray, normal: np.ndarray, factor: np.ndarray, g: np.ndarray, g_uv: np.ndarray) -> None:
    """Gradients of u and v from those of the factor, through (b, c, det)."""
    _, c, det = _covariance(uv, normal)
    g_b = -g[1] / np.sqrt(2 * c * det)
    g_c = (g[0] * factor[0] - g[1] * factor[1] - g[2] * factor[2]) / (2 * c)
    g_det = -(g[0] * factor[0] + g[1] * factor[1]) / (2 * det)
    _cross(uv[1], normal, g_uv[0])
    _cross(normal, uv[0], g_uv[1])
    for k in range(3):
        g_uv[0, k] = g_b * uv[1, k] + 2 * g_det * (g_uv[0, k] + BLUR * uv[0, k])
        g_uv[1, k] = g_b * uv[0, k] + 2 * g_c * uv[1, k] + 2 * g_det * (g_uv[1, k] + BLUR * uv[1, k])


@njit(**EXACT)
def _camera_adjoint(mean: np.ndarray, p: np.ndarray, K: np.ndarray, limits: tuple[float, float, float, float],
                    viewmat: np.ndarray, g_W: np.ndarray, g_centre: np.ndarray, g_depth: float, g_mean: np.ndarray,
                    g_view: np.ndarray) -> None:  # fmt: skip
    """Gradients of the mean, and of the camera (added to g_view [3, 4]), from those of W, the centre and the depth."""
    g_p = (g_centre[0] * K[0, 0] / p[2], g_centre[1] * K[1, 1] / p[2])
    g_p0, g_p1 = g_p
    g_p2 = g_depth - (g_p[0] * p[0] + g_p[1] * p[1]) / p[2]
    for r in range(2):
        raw = p[r] / p[2]
        slope = min(max(raw, limits[2 * r]), limits[2 * r + 1])
        gain = K[r, r] / p[2]
        along, across = _dot(g_W[r], viewmat[r]), _dot(g_W[r], viewmat[2])
        g_p2 -= gain / p[2] * (along - slope * across)
        if raw == slope:
            g_slope = -gain * across
            if r == 0:
                g_p0 += g_slope / p[2]
            else:
                g_p1 += g_slope / p[2]
            g_p2 -= g_slope * raw / p[2]
        for k in range(3):
            g_view[r, k] += gain * g_W[r, k]
            g_view[2, k] -= gain * slope * g_W[r, k]
    for k in range(3):
        g_mean[k] = viewmat[0, k] * g_p0 + viewmat[1, k] * g_p1 + viewmat[2, k] * g_p2
        g_view[0, k] += g_p0 * mean[k]
        g_view[1, k] += g_p1 * mean[k]
        g_view[2, k] += g_p2 * mean[k]
    g_view[0, 3] += g_p0
    g_view[1, 3] += g_p1
    g_view[2, 3] += g_p2


@njit(parallel=True, **EXACT)
def project_adjoint(means: np.ndarray, quats: np.ndarray, scales: np.ndarray, viewmat: np.ndarray, K: np.ndarray,
                    width: int, height: int, factors: np.ndarray, depths: np.ndarray, g_centres: np.ndarray,
                    g_factors: np.ndarray, g_depths: np.ndarray
                    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Gradients of means [N, 3], quats [N, 4], scales [N, 3] and viewmat [4, 4]."""
    N = len(means)
    g_means, g_quats, g_scales = (
        np.zeros((N, 3), np.float32),
        np.zeros((N, 4), np.float32),
        np.zeros((N, 3), np.float32),
    )
    blocks = (N + BLOCK - 1) // BLOCK
    g_views = np.zeros((blocks, 4, 4))
    limits = _limits(K, width, height)
    for block in prange(blocks):
        p, normal, R, g_R = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
        W, B, uv = np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3))
        g_uv, g_W = np.empty((2, 3)), np.empty((2, 3))
        for i in range(block * BLOCK, min(N, (block + 1) * BLOCK)):
            if depths[i] == 0:
                continue
            _to_camera(means[i], viewmat, p)
            length = _rotation(quats[i], R)
            _screen_axes(p, K, limits, viewmat, R, scales[i], W, B, uv)
            _axes_adjoint(uv, normal, factors[i], g_factors[i], g_uv)
            for k in range(3):
                g_scales[i, k] = g_uv[0, k] * B[0, k] + g_uv[1, k] * B[1, k]
                g_uv[0, k] *= scales[i, k]
                g_uv[1, k] *= scales[i, k]
            for c in range(3):
                g_W[0, c], g_W[1, c] = _dot(g_uv[0], R[c]), _dot(g_uv[1], R[c])
                for k in range(3):
                    g_R[c, k] = W[0, c] * g_uv[0, k] + W[1, c] * g_uv[1, k]
            _quat_adjoint(quats[i], length, g_R, g_quats[i])
            _camera_adjoint(means[i], p, K, limits, viewmat, g_W, g_centres[i], g_depths[i], g_means[i], g_views[block])
    return g_means, g_quats, g_scales, g_views.sum(axis=0)
