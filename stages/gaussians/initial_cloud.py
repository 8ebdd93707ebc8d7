"""The Gaussians that training begins with: lifted points, labelled static or dynamic by votes over the frames."""

import sys

import cv2
import numpy as np
import torch

from stages.deformation.motion_models import Deformation
from stages.gaussians.births import birth_frames, birth_gap, movers_stride, with_life_spans
from stages.gaussians.lifting import Points, frame_order, join, lift_dynamic, lift_static, make_cloud
from stages.gaussians.skinning import skinned, to_canonical
from stages.gaussians.training_frames import TrainingFrames
from stages.gaussians.votes import dynamic_share, inverse, static_share
from stages.shared.frame_store import Computed, PackedMasks
from stages.splatting.cloud import Cloud

OUTLINE = 0.006
"""Width of the uncertain band along a mask's outline, as a share of the frame's longer side: 3 of 512 px. With a
narrower one static Gaussians keep the colours of the movers' rim, which lowers held-out PSNR."""

MOST_CLAIMED = 2
"""Static points are lifted up to this many times `max_gaussians`: some are left out again, as movers claim them."""


def cloud_within(
    seen: TrainingFrames,
    deformation: Deformation | None,
    canonical: int,
    stride_px: int,
    K: int,
    sh_degree: int,
    max_gaussians: int,
    movers_every: int = 0,
) -> tuple[Cloud, int]:
    """`initial_cloud` at the smallest stride from `stride_px` on that gives at most `max_gaussians`, and that stride.

    All other arguments are those of `initial_cloud`.
    """
    while True:
        cloud = initial_cloud(seen, deformation, canonical, stride_px, K, sh_degree, movers_every, max_gaussians)
        if len(cloud.means) <= max_gaussians:
            return cloud, stride_px
        stride_px += 1


def initial_cloud(
    seen: TrainingFrames,
    deformation: Deformation | None,
    canonical: int,
    stride_px: int,
    K: int,
    sh_degree: int,
    movers_every: int = 0,
    max_gaussians: int = sys.maxsize,
) -> Cloud:
    """Gaussians of the whole scene; without a deformation every pixel is static.

    Each candidate is labelled by a vote over the frames in which it is visible. An unmasked pixel becomes dynamic if
    more than half of these frames mask it. A masked pixel becomes static, at the place where it was lifted, if the
    share of frames that show it there unmasked exceeds the share that mask it along its motion, with life spans of
    those around its own. If the motion is wrong,
    few masks cover it on its way, but then no frame shows it at rest either, and it stays dynamic.

    Args:
        canonical: index (into the F training frames) of the canonical frame.
        stride_px: distance between lifted pixels, px. K: control points per Gaussian.
        movers_every: dynamic Gaussians have life spans, and are lifted from one frame in this many, from the others
            where none of them is, more densely where there is room (`movers_stride`); 0: they are there at all times,
            and each frame adds what those before do not show.
        max_gaussians: to stay within, movers are lifted from fewer frames, but from no less than half as many; a cloud
            that is beyond it need not be complete.
    """
    order = frame_order(len(seen.images), canonical)
    if deformation is None:
        everything = Computed(len(seen.images), lambda _: np.ones(seen.size, bool))
        points = lift_static(seen, order, stride_px, everything, max_gaussians)
        return make_cloud(points, points.positions, np.zeros(len(points.frames), bool), sh_degree)
    widened = _widened(seen)
    static = lift_static(seen, order, stride_px, inverse(widened), MOST_CLAIMED * max_gaussians)
    claimed = dynamic_share(seen, lambda _: static.positions, seen.masks) > 0.5
    claimed_times = seen.times[static.frames[claimed]]
    recovered, found = to_canonical(static.positions[claimed], claimed_times, deformation, K)
    room = max_gaussians - len(static.frames)
    births = birth_frames(seen.masked, movers_every, stride_px**2 * room) if movers_every else []
    stride_of_movers_px = stride_px
    if births:  # a mover that passes by may show between these frames only
        stride_of_movers_px = movers_stride(seen.masked, births, stride_px, room)
        order = births + [f for f in range(len(seen.images)) if f not in births and seen.masked[f]]
    left = max_gaussians - int((~claimed).sum() + found.sum())
    most = room if births else sys.maxsize
    dynamic, means = lift_dynamic(seen, order, stride_of_movers_px, deformation, K, births, most, left)
    if len(means) > left:  # too many, whatever the votes
        moves = np.ones(len(means), bool)
    else:
        moves = _stay_dynamic(seen, dynamic, means, widened, deformation, K, births)
    points = join([static[~claimed], static[claimed][found], dynamic])
    positions = np.concatenate([
        static.positions[~claimed], recovered[found], np.where(moves[:, None], means, dynamic.positions)
    ])  # fmt: skip
    labels = np.concatenate([np.zeros((~claimed).sum(), bool), np.ones(found.sum(), bool), moves])
    cloud = make_cloud(points, positions, labels, sh_degree)
    return with_life_spans(cloud, points.frames[np.argsort(labels, kind="stable")], seen.times, births)


def _widened(seen: TrainingFrames) -> PackedMasks:
    """The masks with their outline, where colours mix and masks and depth are inexact: no static point starts there."""
    size = 2 * max(1, round(OUTLINE * max(seen.size))) + 1
    kernel = np.ones((size, size), np.uint8)
    return PackedMasks((f, cv2.dilate(seen.masks[f].astype(np.uint8), kernel) > 0) for f in range(len(seen.images)))


def _stay_dynamic(
    seen: TrainingFrames,
    points: Points,
    means: np.ndarray,
    masks: PackedMasks,
    deformation: Deformation,
    K: int,
    births: list[int],
) -> np.ndarray:
    """Whether [n] more frames mask a point along its motion than show it unmasked at the place where it was lifted.

    Along its motion, points with life spans are seen in the frames around their own alone: these vote. Where the depth
    is that of a camera which only turns, all frames show the place of a mover at rest.
    """
    with torch.no_grad():
        moving = skinned(torch.as_tensor(means, dtype=torch.float32), deformation, K)

    def moved(f: int) -> np.ndarray:
        with torch.no_grad():
            return np.asarray(moving(float(seen.times[f])).double().numpy())

    reach = 1.01 * birth_gap(seen.times, births) if births else np.inf  # more than rounding beyond the next births

    def alive(f: int) -> np.ndarray:
        return np.asarray(np.abs(seen.times[f] - seen.times[points.frames]) < reach)

    carried = dynamic_share(seen, moved, masks, alive)
    return np.asarray(carried >= static_share(seen, points.positions, masks))
