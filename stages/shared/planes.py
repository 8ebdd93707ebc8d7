"""Planes that fit the depth around each pixel."""

import cv2
import numpy as np

COARSE_PX, STEADY = 4, 1 / 16
"""Planes are fitted to means over squares of pixels, small beside the window; STEADY is added to the variances of the
coordinates, so that few of them give a level plane."""
TINY = 1e-9


def surrounding_plane(inverse_depth: np.ndarray, trust: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Inverse depth [h, w] of the plane that fits best around each pixel, and the mean trust [h, w] there.

    The inverse depth of a plane is linear in pixel coordinates: where a mover hides far ground, a mean of what is known
    around it would be that of ground nearer by.

    Args:
        inverse_depth: [h, w], of any value where the trust is 0. trust: [h, w], with which each pixel counts.
        share: width of the square around a pixel, as a share of the longer side of the frame.
    """
    h, w = inverse_depth.shape
    size = max(w // COARSE_PX, 1), max(h // COARSE_PX, 1)
    window = 2 * round(share * max(size) / 2) + 1
    v, u = np.mgrid[: size[1], : size[0]] - np.array([size[1] / 2, size[0] / 2])[:, None, None]
    weighed = np.dstack([trust, trust * np.where(trust > 0, inverse_depth, 0)]).astype(np.float64)
    trust, d = np.moveaxis(cv2.resize(weighed, size, interpolation=cv2.INTER_AREA), -1, 0)
    d = d / np.maximum(trust, TINY)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.asarray(cv2.boxFilter(values, cv2.CV_64F, (window, window), borderType=cv2.BORDER_CONSTANT))

    total = mean(trust) + TINY
    u_mean, v_mean, d_mean = (mean(trust * values) / total for values in (u, v, d))
    uu, vv = (mean(trust * x * x) / total - x_mean**2 + STEADY for x, x_mean in ((u, u_mean), (v, v_mean)))
    uv = mean(trust * u * v) / total - u_mean * v_mean
    ud, vd = (mean(trust * x * d) / total - x_mean * d_mean for x, x_mean in ((u, u_mean), (v, v_mean)))
    determinant = uu * vv - uv**2
    slopes = (ud * vv - vd * uv) / determinant, (vd * uu - ud * uv) / determinant
    planes = np.dstack([d_mean - slopes[0] * u_mean - slopes[1] * v_mean, *slopes, total])
    level, of_u, of_v, known = np.moveaxis(cv2.resize(planes.astype(np.float32), (w, h)), -1, 0)
    at_u, at_v = ((np.arange(n) + 0.5) * m / n - (1 + m) / 2 for n, m in ((w, size[0]), (h, size[1])))
    plane = np.maximum(level + of_u * at_u + of_v * at_v[:, None], 0)
    return np.asarray(plane, np.float32), np.asarray(known)
