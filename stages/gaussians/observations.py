"""What Gaussians are trained on: the training frames with their masks, dense depth and cameras."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from stages.control.deformation import Deformation
from stages.shared.cameras import project

COLOUR_STD = 0.06
"""Difference of colour (0..1) across which depth is not carried over."""
UNLIKE_WEIGHT = 1e-4
"""Weight of a grid pixel of any other colour, so that a pixel unlike all four gets their bilinear mean."""
FARTHEST = 1e3
"""Depth is at most this many times the median depth: sky has inverse depth 0."""


@dataclass(frozen=True)
class Observations:
    """F training frames.

    Attributes:
        images: [F, H, W, 3] float32 in 0..1. masks: [F, H, W] bool, true on moving parts.
        depths: [F, H, W] float32, z-depth in scene units. guessed: [F, H, W] bool, depth was not triangulated.
        cam_from_world: [F, 4, 4]. Ks: [F, 3, 3] px. times: [F] in 0..1.
    """

    images: np.ndarray
    masks: np.ndarray
    depths: np.ndarray
    guessed: np.ndarray
    cam_from_world: np.ndarray
    Ks: np.ndarray
    times: np.ndarray


def dense_depth(inverse_depth: np.ndarray, image: np.ndarray, stride_px: int) -> np.ndarray:
    """Full-size z-depth [H, W] from inverse depth [h, w] on the pose stage's grid, with edges where the frame has them.

    Grid pixel k lies at frame pixel s k + (s - 1) / 2. Joint bilateral upsampling (Kopf et al. 2007) over the four
    surrounding grid pixels: bilinear weights times likeness of colour. Inverse depth is linear across planes in the
    image. Against rendered truth it leaves a third to a fifth of the pixels wrong that a guided filter does.

    Args:
        image: [H, W, 3] float32 in 0..1.
    """
    rows, row_weights = _grid_neighbours(image.shape[0], inverse_depth.shape[0], stride_px)
    columns, column_weights = _grid_neighbours(image.shape[1], inverse_depth.shape[1], stride_px)
    at_row = np.minimum(np.arange(len(inverse_depth)) * stride_px + stride_px // 2, len(image) - 1)
    at_column = np.minimum(np.arange(inverse_depth.shape[1]) * stride_px + stride_px // 2, image.shape[1] - 1)
    grid_image = image[np.ix_(at_row, at_column)]
    total, weight = np.zeros(image.shape[:2]), np.zeros(image.shape[:2])
    for v, v_weight in zip(rows, row_weights, strict=True):
        for u, u_weight in zip(columns, column_weights, strict=True):
            unlike = np.square(image - grid_image[np.ix_(v, u)]).sum(axis=-1)
            w = np.outer(v_weight, u_weight) * (np.exp(-unlike / (2 * COLOUR_STD**2)) + UNLIKE_WEIGHT)
            total += w * inverse_depth[np.ix_(v, u)]
            weight += w
    inverse = total / weight
    return (1 / np.maximum(inverse, np.median(inverse) / FARTHEST)).astype(np.float32)


def _grid_neighbours(size: int, grid_size: int, stride_px: int) -> tuple[np.ndarray, np.ndarray]:
    """The two grid indices [2, size] around each of `size` pixels, clipped, and their linear weights [2, size]."""
    at = (np.arange(size) - (stride_px - 1) / 2) / stride_px
    low = np.floor(at).astype(int)
    return np.stack([low, low + 1]).clip(0, grid_size - 1), np.stack([1 - (at - low), at - low])


def with_mover_depth(seen: Observations, deformation: Deformation) -> Observations:
    """Replace guessed depth inside the masks by that of the control points near the pixel.

    The pose stage cannot triangulate what moves and fills it from the background; the control points know better,
    and Gaussians must lie where the control points that carry them are.
    """
    depths = seen.depths.copy()
    for f in range(len(depths)):
        v, u = np.nonzero(seen.masks[f] & seen.guessed[f])
        with torch.no_grad():
            _, translations = deformation(torch.tensor([seen.times[f]]))
        points = (deformation.points + translations[0]).double().numpy()
        uv, z = project(points, seen.cam_from_world[f], seen.Ks[f])
        front = z > 0
        if len(u) and front.any():
            K = min(4, int(front.sum()))
            dist, index = cKDTree(uv[front]).query(np.stack([u, v], axis=-1), k=np.arange(1, K + 1))
            weights = 1 / (dist + 1)
            inverse = (weights / z[front][index]).sum(axis=1) / weights.sum(axis=1)
            depths[f, v, u] = 1 / inverse
    return Observations(seen.images, seen.masks, depths, seen.guessed, seen.cam_from_world, seen.Ks, seen.times)
