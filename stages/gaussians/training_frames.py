"""The training frames with their masks, dense depth and cameras."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree

from stages.deformation.motion_models import Deformation
from stages.shared.cameras import project, unproject
from stages.splatting.gaussian_model import GaussianScene
from stages.splatting.shutter import Moments, Shutter, instant, open_moments

REACH = 6.0
"""Points farther than this many kernel radii from their nearest control point are treated as static."""


@dataclass(frozen=True)
class TrainingFrames:
    """F training frames.

    Attributes:
        images: [F, H, W, 3] float32 in 0..1. masks: [F, H, W] bool, true on moving parts.
        depths: [F, H, W] float32, z-depth in scene units.
        guessed: [F, H, W] bool, true where the depth was not triangulated but filled in.
        cam_from_world: [F, 4, 4]. Ks: [F, 3, 3] px. times: [F] in 0..1.
        scene: [H, W] bool, false where something is burnt into all frames; None: nothing is.
        smeared: [F] the moments over which each frame is averaged; None: each shows a single one.
    """

    images: np.ndarray
    masks: np.ndarray
    depths: np.ndarray
    guessed: np.ndarray
    cam_from_world: np.ndarray
    Ks: np.ndarray
    times: np.ndarray
    scene: np.ndarray | None = None
    smeared: tuple[Moments, ...] | None = None

    def picture(self, f: int) -> Moments:
        """The moments of frame f, 0..F-1."""
        single = instant(float(self.times[f]), self.cam_from_world[f], self.Ks[f])
        return single if self.smeared is None else self.smeared[f]


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


def with_smear(seen: TrainingFrames, scene: GaussianScene, shutter: Shutter) -> TrainingFrames:
    """Give every frame the moments over which it is averaged, as many as its smear is long."""
    height, width = seen.images.shape[1:3]
    rows = np.rint(seen.times * (len(shutter.Ks) - 1)).astype(int).tolist()
    return replace(seen, smeared=tuple(open_moments(scene, shutter, row, (width, height)) for row in rows))


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
