"""What Gaussians are trained on: the training frames with their masks, dense depth and cameras."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree

from stages.control.deformation import Deformation
from stages.shared.cameras import pixel_grid, project

GUIDE_EPS = 1e-3
"""Regularisation of the guided filter: contrast of the frame (0..1), squared, below which depth is smoothed across."""
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

    Grid pixel k lies at frame pixel s k + (s - 1) / 2. The guided filter (He et al. 2010) works on inverse depth,
    which is linear across planes in the image.

    Args:
        image: [H, W, 3] float32 in 0..1.
    """
    uv = (pixel_grid(*image.shape[:2]) - (stride_px - 1) / 2) / stride_px
    u, v = np.moveaxis(uv.astype(np.float32), -1, 0)
    coarse = cv2.remap(inverse_depth.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    unit = float(np.median(coarse))  # the filter adds constants: keep it independent of the scene's unit
    smooth = cv2.ximgproc.guidedFilter(image, coarse / unit, radius=stride_px, eps=GUIDE_EPS)
    lowest, highest = float(coarse.min()) / unit, float(coarse.max()) / unit
    return np.asarray(1 / (unit * np.clip(smooth, max(lowest, 1 / FARTHEST), highest)), np.float32)


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
