"""Pixels of several training frames lifted by depth, and the Gaussians made of them."""

import itertools
import sys
from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from stages.deformation.motion_models import Deformation
from stages.gaussians.births import with_life_spans
from stages.gaussians.skinning import skin, to_canonical
from stages.gaussians.training_frames import TrainingFrames
from stages.gaussians.votes import DEPTH_TOLERANCE, pixels_of
from stages.shared.cameras import unproject
from stages.shared.frame_store import Frames
from stages.splatting import sh
from stages.splatting.cloud import Cloud
from stages.splatting.life_spans import presence
from stages.splatting.raster_bins import MIN_ALPHA
from stages.splatting.rasterize import rasterize

LIFTED_FRAMES = 8
"""Frames that are lifted after the canonical one; each adds what the frames before it do not show."""
NEW_SHARE = 0.05
"""A frame between two lifted ones is lifted too if all of them leave this share of it uncovered. In seven library
scenes of 14 to 200 frames none does: at most 0.044."""
WIDEST_GAP = 32
"""Frames between lifted ones are looked at this close to one another at least: a camera that turned round between two
of them would not be noticed halfway."""
SCALE_SHARE = 0.5
"""Initial standard deviation as a share of the distance between neighbouring Gaussians."""
OPACITY = 0.8
COVERED, HOLE = 0.5, 0.1
"""Alpha of the dynamic Gaussians below which a masked pixel needs one of its own, and below which it has none at all.
With life spans only the latter counts: with the former held-out movers of fast_chase are 0.2 dB worse."""


@dataclass(frozen=True)
class Points:
    """n lifted pixels: positions [n, 3], colours [n, 3] 0..1, footprints [n] (scene units), frames [n] of origin.

    A footprint is the distance between neighbouring lifted pixels at the depth of the point.
    """

    positions: np.ndarray
    colours: np.ndarray
    footprints: np.ndarray
    frames: np.ndarray

    def __getitem__(self, rows: np.ndarray) -> "Points":
        return Points(*(values[rows] for values in vars(self).values()))


def join(parts: list[Points]) -> Points:
    """All points of `parts`, in order."""
    return Points(*(np.concatenate(values) for values in zip(*(vars(part).values() for part in parts), strict=True)))


def lift(seen: TrainingFrames, f: int, keep: np.ndarray, stride_px: int) -> Points:
    """Points lifted from every `stride_px`-th pixel of frame f, each way, where keep [H, W] bool is true."""
    grid = np.zeros(keep.shape, bool)
    grid[stride_px // 2 :: stride_px, stride_px // 2 :: stride_px] = True
    v, u = np.nonzero(keep & grid if seen.scene is None else keep & grid & seen.scene)
    depth = seen.depths[f][v, u].astype(float)
    positions = unproject(np.stack([u, v], axis=-1), depth, seen.cam_from_world[f], seen.Ks[f])
    focal_px = np.sqrt(seen.Ks[f, 0, 0] * seen.Ks[f, 1, 1])
    return Points(positions, seen.images[f][v, u], depth / focal_px * stride_px, np.full(len(u), f))


def frame_order(F: int, first: int) -> list[int]:
    """Indices of the frames to lift: `first`, then at most LIFTED_FRAMES spread over all F, with both ends first."""
    spread = np.unique(np.linspace(0, F - 1, min(LIFTED_FRAMES, F)).round().astype(int)).tolist()
    ends_first = spread[:1] + spread[-1:] + spread[1:-1]
    return list(dict.fromkeys([first, *ends_first]))


def lift_static(
    seen: TrainingFrames, order: list[int], stride_px: int, static: Frames[np.ndarray], useless: int = sys.maxsize
) -> Points:
    """Lifted points of several frames: each adds those of its `static` pixels [H, W] that no point covers yet.

    A long path shows more than the frames of `order` do: the gaps between them are halved, and the frames in their
    middles lifted, as long as these show enough that is new.

    Args:
        order: indices of the frames, the first of which contributes all its static pixels.
        stride_px: distance between lifted pixels, px.
        useless: beyond so many points the rest of the frames is left out, as the caller has no use for the result.
    """
    points = lift(seen, order[0], static[order[0]], stride_px)
    for f in order[1:]:
        points = join([points, lift(seen, f, _uncovered(seen, f, points, stride_px, static), stride_px)])
    gaps = deque(itertools.pairwise(sorted(order)))
    while gaps and len(points.frames) <= useless:
        first, last = gaps.popleft()
        middle = (first + last) // 2
        if middle == first:
            continue
        new = _uncovered(seen, middle, points, stride_px, static)
        adds = np.count_nonzero(new) >= NEW_SHARE * new.size
        if adds:
            points = join([points, lift(seen, middle, new, stride_px)])
        if adds or last - first > WIDEST_GAP:
            gaps += [(first, middle), (middle, last)]
    return points


def _uncovered(seen: TrainingFrames, f: int, points: Points, stride_px: int, static: Frames[np.ndarray]) -> np.ndarray:
    """Static pixels [H, W] of frame f that no point covers."""
    return np.asarray(static[f] & ~_covered(seen, f, points.positions, stride_px))


def _covered(seen: TrainingFrames, f: int, positions: np.ndarray, stride_px: int) -> np.ndarray:
    """Pixels [H, W] of frame f that have a point within the stride, at or in front of the surface there."""
    height, width = seen.size
    u, v, z, inside = pixels_of(seen, f, positions)
    nearest = np.full((height, width), np.inf, np.float32)
    np.minimum.at(nearest, (v[inside], u[inside]), z[inside].astype(np.float32))
    size = 2 * stride_px + 1
    nearest = cv2.erode(nearest, np.ones((size, size), np.uint8))
    return np.asarray(nearest < seen.depths[f] * (1 + DEPTH_TOLERANCE))


def lift_dynamic(
    seen: TrainingFrames,
    order: list[int],
    stride_px: int,
    deformation: Deformation,
    K: int,
    births: list[int],
    most: int = sys.maxsize,
    useless: int = sys.maxsize,
) -> tuple[Points, np.ndarray]:
    """Lifted points of masked pixels that no dynamic point covers yet, and their canonical positions [n, 3].

    Args:
        order: indices of the frames. stride_px: distance between lifted pixels, px. K: control points per Gaussian.
        births: frames whose masked pixels are all lifted, covered or not; points then have life spans.
        most: frames other than `births` add none beyond this many points.
        useless: beyond so many points the rest of the frames is left out, as the caller has no use for the result.
    """
    parts: list[Points] = []
    canonical: list[np.ndarray] = []
    for f in order:
        if parts and sum(map(len, canonical)) > useless:
            break
        need, adds = seen.masks[f], bool(parts) and f not in births
        if adds:
            alpha = _dynamic_alpha(seen, f, join(parts), np.concatenate(canonical), deformation, K, births)
            need = need & (alpha < (HOLE if births else COVERED))
        points = lift(seen, f, need, stride_px)
        if adds and sum(map(len, canonical)) + len(points.frames) > most:
            continue
        positions, found = to_canonical(points.positions, seen.times[points.frames], deformation, K)
        parts.append(points[found])
        canonical.append(positions[found])
    return join(parts), np.concatenate(canonical)


@torch.no_grad()
def _dynamic_alpha(
    seen: TrainingFrames,
    f: int,
    points: Points,
    canonical: np.ndarray,
    deformation: Deformation,
    K: int,
    births: list[int],
) -> np.ndarray:
    """Rendered alpha [H, W] of the dynamic points alone in frame f."""
    height, width = seen.size
    cloud = make_cloud(points, canonical, np.ones(len(canonical), bool), sh_degree=0)
    cloud = with_life_spans(cloud, points.frames, seen.times, births)
    opacities = cloud.logits.sigmoid() * presence(cloud.births, cloud.log_spans, float(seen.times[f]))
    there = opacities > MIN_ALPHA
    means = skin(cloud.means[there], float(seen.times[f]), deformation, K)
    shapes = (cloud.quats[there], cloud.log_scales[there].exp(), opacities[there], cloud.sh[there])
    cameras = torch.tensor(seen.cam_from_world[f][None]), torch.tensor(seen.Ks[f][None])
    rendered = rasterize(means, *shapes, *cameras, width, height, 0, near_plane_of(seen))
    return rendered.alpha[0].numpy()


def near_plane_of(seen: TrainingFrames) -> float:
    """Near plane in scene units: a hundredth of the median depth."""
    return 0.01 * seen.median_depth


def make_cloud(points: Points, positions: np.ndarray, dynamic: np.ndarray, sh_degree: int) -> Cloud:
    """Isotropic Gaussians of the points at `positions` [n, 3], static ones first.

    Args:
        dynamic: [n] bool.
    """
    order = np.argsort(dynamic, kind="stable")
    footprints = torch.as_tensor(points.footprints[order], dtype=torch.float32)
    n = len(order)
    coefficients = torch.zeros(n, sh.coefficients(sh_degree), 3)
    coefficients[:, 0] = sh.colour_to_sh(torch.as_tensor(points.colours[order], dtype=torch.float32))
    return Cloud(
        means=torch.as_tensor(positions[order], dtype=torch.float32),
        footprints=footprints,
        log_scales=(SCALE_SHARE * footprints).log()[:, None].repeat(1, 3),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        logits=torch.full((n,), float(np.log(OPACITY / (1 - OPACITY)))),
        sh=coefficients,
        dynamic=torch.as_tensor(dynamic[order]),
    )
