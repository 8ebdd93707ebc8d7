"""Radial distortion: x_d = x (1 + k1 r^2 + k2 r^4) on coordinates about the principal point (OpenCV, COLMAP's RADIAL).

On rays with z = 1 the coefficients are k1 and k2; on pixels they are k1 / f^2 and k2 / f^4, by which an image can be
undistorted without its focal length f.
"""

import numpy as np

STEPS = 30
"""Largest number of Newton steps of the inverse; it takes four to six but near the fold."""
TOLERANCE = 1e-15
"""Relative step of the radius at which the inverse has converged."""


def distort(xy: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Where the lens maps points [..., 2] of a pinhole camera."""
    squared = (xy**2).sum(axis=-1, keepdims=True)
    return np.asarray(xy * (1 + squared * (coefficients[0] + squared * coefficients[1])))


def undistort(xy: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """The points [..., 2] that the lens maps to points `xy`: the exact inverse of `distort` inside its fold.

    Newton's method on the radius. Points that lie outside of what the lens can reach go to the radius of the fold.
    """
    k1, k2 = float(coefficients[0]), float(coefficients[1])
    distorted = np.linalg.norm(xy, axis=-1)
    limit = fold(coefficients)
    radius = np.minimum(distorted, limit)
    for _ in range(STEPS):
        squared = radius**2
        slope = np.maximum(1 + squared * (3 * k1 + 5 * k2 * squared), 1e-6)
        step = (distorted - radius * (1 + squared * (k1 + k2 * squared))) / slope
        radius = np.clip(radius + step, 0.0, limit)
        if (np.abs(step) <= TOLERANCE * radius).all():
            break
    ratio = np.divide(radius, distorted, out=np.ones_like(distorted), where=distorted > 0)
    return np.asarray(xy * ratio[..., None])


def fold(coefficients: np.ndarray) -> float:
    """The radius, before distortion, from which on larger radii are mapped nearer to the centre; infinity if none is.

    It is the smallest root of the derivative of the distorted radius, 1 + 3 k1 r^2 + 5 k2 r^4.
    """
    roots = np.roots([5 * float(coefficients[1]), 3 * float(coefficients[0]), 1.0])
    squares = [root.real for root in roots if abs(root.imag) < 1e-12 and root.real > 0]
    return float(np.sqrt(min(squares))) if squares else float("inf")
