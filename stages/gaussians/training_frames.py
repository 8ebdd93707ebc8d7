"""The training frames with their masks, dense depth and cameras."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree

from stages.deformation.motion_models import Deformation
from stages.shared.cameras import frame_from_grid, grid_from_frame, project, unproject

COLOUR_STD = 0.06
"""Standard deviation of the colour weights (colours in 0..1): depth is not interpolated across larger differences."""
UNLIKE_WEIGHT = 1e-4
"""Added to the colour weights: a pixel whose colour differs from all four grid pixels gets their bilinear mean."""
REACH = 6.0
"""Points farther than this many kernel radii from their nearest control point are treated as static."""
FARTHEST = 1e3
"""Limit of depth, as a multiple of the median depth: the inverse depth of the sky is 0."""


@dataclass(frozen=True)
class TrainingFrames:
    """F training frames.

    Attributes:
        images: [F, H, W, 3] float32 in 0..1. masks: [F, H, W] bool, true on moving parts.
        depths: [F, H, W] float32, z-depth in scene units.
        guessed: [F, H, W] bool, true where the depth was not triangulated but filled in.
        cam_from_world: [F, 4, 4]. Ks: [F, 3, 3] px. times: [F] in 0..1.
    """

    images: np.ndarray
    masks: np.ndarray
    depths: np.ndarray
    guessed: np.ndarray
    cam_from_world: np.ndarray
    Ks: np.ndarray
    times: np.ndarray


def dense_depth(inverse_depth: np.ndarray, image: np.ndarray, stride_px: float) -> np.ndarray:
    """Full-size z-depth [H, W] from inverse depth [h, w] on the grid of `ba`, with its edges at those of the frame.

    Joint bilateral upsampling (Kopf et al. 2007) over the four surrounding grid pixels: bilinear weights times colour
    similarity. Inverse depth is interpolated because it is linear in the image across a plane. Fewer pixels are wrong
    than with a guided filter.

    Args:
        image: [H, W, 3] float32 in 0..1.
        stride_px: frame pixels per grid pixel, as in `frame_from_grid`.
    """
    rows, row_weights = _grid_neighbours(image.shape[0], inverse_depth.shape[0], stride_px)
    columns, column_weights = _grid_neighbours(image.shape[1], inverse_depth.shape[1], stride_px)
    centres = (_grid_centres(*sizes, stride_px) for sizes in zip(image.shape[:2], inverse_depth.shape, strict=True))
    grid_image = image[np.ix_(*centres)]
    total, weight = np.zeros(image.shape[:2]), np.zeros(image.shape[:2])
    for v, v_weight in zip(rows, row_weights, strict=True):
        for u, u_weight in zip(columns, column_weights, strict=True):
            unlike = np.square(image - grid_image[np.ix_(v, u)]).sum(axis=-1)
            w = np.outer(v_weight, u_weight) * (np.exp(-unlike / (2 * COLOUR_STD**2)) + UNLIKE_WEIGHT)
            total += w * inverse_depth[np.ix_(v, u)]
            weight += w
    inverse = total / weight
    return (1 / np.maximum(inverse, np.median(inverse) / FARTHEST)).astype(np.float32)


def nearest_on_frame(grid: np.ndarray, stride_px: float, height: int, width: int) -> np.ndarray:
    """Values [F, h, w] on the grid of `ba`, looked up at every pixel of the frames: [F, height, width]."""
    rows, columns = (
        np.minimum(grid_from_frame(np.arange(size), stride_px) + 0.5, grid_size - 1).astype(int)
        for size, grid_size in zip((height, width), grid.shape[1:], strict=True)
    )
    return np.asarray(grid[:, rows][:, :, columns])


def _grid_centres(size: int, grid_size: int, stride_px: float) -> np.ndarray:
    """Index [grid_size] of the pixel in 0..size - 1 nearest to the centre of each grid pixel; at a tie the higher."""
    at = frame_from_grid(np.arange(grid_size), stride_px)
    return np.minimum((at + 0.5).astype(int), size - 1)


def _grid_neighbours(size: int, grid_size: int, stride_px: float) -> tuple[np.ndarray, np.ndarray]:
    """The two grid indices [2, size] around each of `size` pixels, clipped, and their linear weights [2, size]."""
    at = grid_from_frame(np.arange(size), stride_px)
    low = np.floor(at).astype(int)
    return np.stack([low, low + 1]).clip(0, grid_size - 1), np.stack([1 - (at - low), at - low])


def with_movers(seen: TrainingFrames, deformation: Deformation) -> TrainingFrames:
    """Give masked pixels the depth of nearby control points, and unmask pixels that are too far from all of them.

    `ba` cannot triangulate moving pixels and fills their depth from the static background. The control points have
    depth of their own, and Gaussians must lie close to the control points that move them. A masked pixel farther than
    REACH kernel radii from its nearest control point (a false mask, or a mask over the whole image) counts as static;
    otherwise no Gaussian would cover it.
    """
    depths, masks = seen.depths.copy(), seen.masks.copy()
    radii = deformation.log_radii.detach().exp().double().numpy()
    for f in range(len(depths)):
        v, u = np.nonzero(masks[f])
        with torch.no_grad():
            _, translations = deformation(torch.tensor([seen.times[f]]))
        points = (deformation.points + translations[0]).double().numpy()
        pixels, pose, K = np.stack([u, v], axis=-1), seen.cam_from_world[f], seen.Ks[f]
        guess = _depth_from_points(pixels, points, pose, K)
        depth = np.where(seen.guessed[f, v, u] & np.isfinite(guess), guess, depths[f, v, u])
        dist, nearest = cKDTree(points).query(unproject(pixels.astype(float), depth, pose, K))
        carried = dist < REACH * radii[nearest]
        depths[f, v[carried], u[carried]] = depth[carried]
        masks[f, v[~carried], u[~carried]] = False
    return replace(seen, masks=masks, depths=depths)


def _depth_from_points(pixels: np.ndarray, points: np.ndarray, pose: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Depth [n] of pixels [n, 2], the weighted harmonic mean over the four of the points [P, 3] nearest in the image.

    It is infinite if no point is in front of the camera.
    """
    z = points @ pose[2, :3] + pose[2, 3]
    front = points[z > 0]
    if len(front) == 0:
        return np.full(len(pixels), np.inf)
    uv, z = project(front, pose, K)
    dist, index = cKDTree(uv).query(pixels, k=np.arange(1, min(4, len(front)) + 1))
    weights = 1 / (dist + 1)
    return np.asarray(weights.sum(axis=1) / (weights / z[index]).sum(axis=1))
