"""The training frames with their masks, dense depth and cameras."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from stages.deformation.motion_models import Deformation
from stages.shared.cameras import project, unproject
from stages.shared.frame_store import Frames, PackedMasks, StoredFrames, median
from stages.shared.log import progress
from stages.splatting.gaussian_model import GaussianScene
from stages.splatting.shutter import Moments, Shutter, instant, open_moments

REACH = 6.0
"""Points farther than this many kernel radii from their nearest control point are treated as static."""


@dataclass(frozen=True)
class TrainingFrames:
    """F training frames. What has a value per pixel is looked up frame by frame: it need not be in memory.

    Attributes:
        images: F times [H, W, 3] float32 in 0..1. masks: F times [H, W] bool, true on moving parts.
        depths: F times [H, W] float32, z-depth in scene units.
        guessed: F times [H, W] bool, true where the depth was not triangulated but filled in.
        cam_from_world: [F, 4, 4]. Ks: [F, 3, 3] px. times: [F] in 0..1.
        scene: [H, W] bool, false where something is burnt into all frames; None: nothing is.
        smeared: [F] the moments over which each frame is averaged; None: each shows a single one.
    """

    images: Frames[np.ndarray]
    masks: Frames[np.ndarray]
    depths: Frames[np.ndarray]
    guessed: Frames[np.ndarray]
    cam_from_world: np.ndarray
    Ks: np.ndarray
    times: np.ndarray
    scene: np.ndarray | None = None
    smeared: tuple[Moments, ...] | None = None

    @cached_property
    def size(self) -> tuple[int, int]:
        """Height and width of the frames in px."""
        height, width = self.images[0].shape[:2]
        return height, width

    @cached_property
    def median_depth(self) -> float:
        """Median of the depth of all pixels, scene units."""
        return median(self.depths)

    @cached_property
    def masked(self) -> np.ndarray:
        """Number [F] of masked pixels of each frame."""
        return np.array([np.count_nonzero(self.masks[f]) for f in range(len(self.masks))])

    @cached_property
    def mean_colour(self) -> np.ndarray:
        """Mean [3] of all pixels, float32."""
        F = len(self.images)
        means = [self.images[f].mean(axis=(0, 1), dtype=float) for f in range(F)]  # float32 holds no sum of 1e7 pixels
        return np.mean(means, axis=0).astype(np.float32)

    def picture(self, f: int) -> Moments:
        """The moments of frame f, 0..F-1."""
        single = instant(float(self.times[f]), self.cam_from_world[f], self.Ks[f])
        return single if self.smeared is None else self.smeared[f]


def with_movers(seen: TrainingFrames, deformation: Deformation, scratch: Path | None = None) -> TrainingFrames:
    """Give masked pixels the depth of nearby control points, and unmask pixels that are too far from all of them.

    `ba` cannot triangulate moving pixels and fills their depth from the static background. The control points have
    depth of their own, and Gaussians must lie close to the control points that move them. A masked pixel farther than
    REACH kernel radii from its nearest control point (a false mask, or a mask over the whole image) counts as static;
    otherwise no Gaussian would cover it.

    Args:
        scratch: folder on whose disk the depth is kept; None: that of temporary files.
    """
    masks, radii = PackedMasks(), deformation.log_radii.detach().exp().double().numpy()

    def depths() -> Iterator[np.ndarray]:
        for f in progress(range(len(seen.depths)), "depth of movers"):
            with torch.no_grad():
                _, translations = deformation(torch.tensor([seen.times[f]]))
            points = (deformation.points + translations[0]).double().numpy()
            depth, mask = _carried(seen, f, points, radii)
            masks.add(f, mask)
            yield depth

    return replace(seen, depths=StoredFrames(depths(), scratch), masks=masks)


def _carried(seen: TrainingFrames, f: int, points: np.ndarray, radii: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth [H, W] and mask [H, W] of frame f given control points [P, 3], where they are then, and their radii [P]."""
    depth, mask = seen.depths[f].copy(), seen.masks[f].copy()
    v, u = np.nonzero(mask)
    pixels, pose, K = np.stack([u, v], axis=-1), seen.cam_from_world[f], seen.Ks[f]
    guess = _depth_from_points(pixels, points, pose, K)
    near = np.where(seen.guessed[f][v, u] & np.isfinite(guess), guess, depth[v, u])
    dist, nearest = cKDTree(points).query(unproject(pixels.astype(float), near, pose, K))
    carried = dist < REACH * radii[nearest]
    depth[v[carried], u[carried]] = near[carried]
    mask[v[~carried], u[~carried]] = False
    return depth, mask


def with_smear(seen: TrainingFrames, scene: GaussianScene, shutter: Shutter) -> TrainingFrames:
    """Give every frame the moments over which it is averaged, as many as its smear is long."""
    height, width = seen.size
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
