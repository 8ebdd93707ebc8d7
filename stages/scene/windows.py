"""Over which pixels a point's colour is averaged in each frame, so that it is the same part of its surface in all.

A pixel shows more of a surface that is farther away, and more along one that is seen at an angle: that grows as the
camera goes past a wall. Texture fades with both, like thin fog and its reverse.
"""

from typing import NamedTuple

import numpy as np

SMOOTH_PX, WIDEST = 1.5, 2.0
"""A colour is averaged over a Gaussian of SMOOTH_PX where a pixel shows most of the surface, and over one of up to
WIDEST times that, and longer than wide, where it shows less."""
FOOTPRINT_PX2 = 1 / 6
"""Variance of what a pixel averages by itself, per axis: the pixel and its reduction to the flow grid."""
TAPS, TAP_WEIGHTS = 3**0.5 * np.array([-1.0, 0.0, 1.0]), np.array([1, 4, 1], np.float32) / 6
"""Places in standard deviations, and their weights, which have the moments of a Gaussian up to the fifth."""


class Windows(NamedTuple):
    """Gaussians in the image.

    Attributes:
        variance: [..., F] px^2, across the longer axis. along: [..., F, 2] px, the longer axis; its square is what the
            variance along it is larger by.
    """

    variance: np.ndarray
    along: np.ndarray

    def of(self, k: int) -> "Windows":
        """Those in frame k."""
        return Windows(self.variance[..., k], self.along[..., k, :])

    @property
    def reach(self) -> np.ndarray:
        """Standard deviation [..., F] px along the longer axis."""
        return np.asarray(np.sqrt(self.variance + np.square(self.along).sum(axis=-1)))


def windows(corners: np.ndarray, shown: np.ndarray) -> Windows:
    """The windows of squares on surfaces.

    Args:
        corners: [g, 4, F, 2] px of the corners of each square, row by row. shown: [g, F] where the square is seen;
            where it has collapsed to a line or a point it counts as not seen.
    """
    a, b, c, d = np.moveaxis(corners, 1, 0)
    J = np.stack([b - a + d - c, c - a + d - b], axis=-1)  # of pixels by places on the surface, in a unit of its own
    shown = shown & (np.abs(np.linalg.det(J)) > 1e-6)
    J = np.where(shown[..., None, None], J, np.eye(2))
    inverse = np.linalg.inv(J)
    pixel = inverse @ np.swapaxes(inverse, -1, -2)  # what a pixel averages of the surface: a covariance
    usual = (pixel * shown[..., None, None]).sum(axis=1) / np.maximum(shown.sum(axis=1), 1)[:, None, None]
    usual = np.where(shown.max(axis=1)[:, None, None], usual, np.eye(2))
    # The least multiple of the mean that holds what a pixel averages in every frame.
    beyond = np.linalg.eigvals(np.linalg.solve(usual[:, None], pixel)).real.max(axis=-1)
    whole = np.where(shown, beyond, 0.0).max(axis=1)[:, None, None] * usual
    image = (SMOOTH_PX**2 + FOOTPRINT_PX2) * J @ whole[:, None] @ np.swapaxes(J, -1, -2)
    variances, axes = np.linalg.eigh(image)
    variances = np.clip(variances - FOOTPRINT_PX2, SMOOTH_PX**2, (WIDEST * SMOOTH_PX) ** 2)
    longer = np.sqrt(variances[..., 1] - variances[..., 0])
    return Windows(variances[..., 0], longer[..., None] * axes[..., 1])
