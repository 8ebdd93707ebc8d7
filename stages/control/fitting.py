"""Stage 1: fit the motion of the control points alone to the tracks, in the image plane.

In world space the fit would be dominated by depth noise. The loss is therefore Huber in pixels, plus a weak term on
relative depth that is weaker where the depth is uncertain.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import smooth_l1_loss

from stages.deformation import lbs
from stages.deformation.motion_models import Deformation, TableDeformation
from stages.shared.adam import Adam
from stages.shared.log import progress

NEIGHBOURS = 4
DEPTH_WEIGHT = 0.3
DEPTH_STD = 0.03
BENDING_WEIGHT = 0.01
"""A weight 30 times as large lowers the error of tracked points between frames by 4 to 27 % but lags where limbs turn
back: held-out frames gain 0.2 dB on a walker and lose 0.5 on a soft body."""
FRAMES_PER_STEP, SHARE_PER_STEP = 6, 1 / 8
"""Frames in a step, and least share of those of a longer clip: Adam turns a gradient that is seldom there into a step
of its rate over the root of how often it is. With 6 of 875 frames a step the median residual was 3.5 px, now 1.6."""
OBSERVATIONS_PER_FRAME = 1000
MOST_AT_ONCE = 500_000
"""Observations whose residuals are computed together."""
STUCK_PX, STUCK_P90_PX = 0.5, 2.0
"""With 256 points one in ten tracks of large_object is off by 2.3 px, with 1000 by 0.5, and held-out movers gain 2.0
dB: the limit of 2 px rests on this one scene."""
NOISE_PX = 0.2
"""Noise of the tracks: a median residual below it is never called stuck."""


@dataclass(frozen=True)
class TrackPositions:
    """Observations of the tracks: M observations of n tracked points in F training frames.

    Attributes:
        canonical: [n, 3] float32, the tracked points in the canonical frame.
        track, frame: [M] int64, point and training frame of each observation.
        uv: [M, 2] float32 in pixels of the full frame. depth: [M] float32. depth_std: [M] float32, relative.
        times: [F] float64 in 0..1, as the knots are. cam_from_world: [F, 4, 4] float32. Ks: [F, 3, 3] float32.
    """

    canonical: Tensor
    track: Tensor
    frame: Tensor
    uv: Tensor
    depth: Tensor
    depth_std: Tensor
    times: Tensor
    cam_from_world: Tensor
    Ks: Tensor


def fit(
    deformation: Deformation, seen: TrackPositions, steps: int, learning_rate: float, arap_weight: float, seed: int
) -> None:
    """Train `deformation` in place with Adam, the learning rate decaying to a twentieth."""
    generator = torch.Generator().manual_seed(seed)
    index, sq_dist = lbs.neighbours(deformation.points, seen.canonical, NEIGHBOURS)
    motion = [parameter for name, parameter in deformation.named_parameters() if name != "log_radii"]
    groups = [{"params": motion, "lr": learning_rate}, {"params": [deformation.log_radii], "lr": 1e-3}]
    optimiser = Adam(groups, fused=True)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimiser, 0.05 ** (1 / max(steps, 1)))
    counts = torch.bincount(seen.frame, minlength=len(seen.times)).tolist()
    rows_of_frame = torch.split(torch.argsort(seen.frame, stable=True), counts)
    sighted = torch.tensor([f for f, rows in enumerate(rows_of_frame) if len(rows)])  # a mover may be seen briefly
    B = max(FRAMES_PER_STEP, int(SHARE_PER_STEP * len(sighted)))
    for _ in progress(range(steps), "stage 1"):
        frames = sighted[torch.randperm(len(sighted), generator=generator)[:B]]
        rows = torch.cat([rows_of_frame[f] for f in frames])
        rows = rows[torch.randint(len(rows), (OBSERVATIONS_PER_FRAME * B,), generator=generator)]
        loss = _loss(deformation, seen, frames, rows, index, sq_dist, arap_weight)
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()


def _loss(
    deformation: Deformation,
    seen: TrackPositions,
    frames: Tensor,
    rows: Tensor,
    index: Tensor,
    sq_dist: Tensor,
    arap_weight: float,
) -> Tensor:
    motion = deformation(seen.times[frames])
    pixels, depths = _residuals(deformation, motion, seen, frames, rows, index, sq_dist)
    loss = smooth_l1_loss(pixels, torch.zeros_like(pixels))
    loss = loss + DEPTH_WEIGHT * smooth_l1_loss(depths, torch.zeros_like(depths))
    spacing_sq = deformation.log_radii.detach().exp().square().mean()
    if arap_weight > 0:
        loss = loss + arap_weight * deformation.arap_loss(seen.times[frames[:2]])
    if isinstance(deformation, TableDeformation):
        loss = loss + BENDING_WEIGHT * deformation.bending() / spacing_sq
    return loss


def _residuals(
    deformation: Deformation,
    motion: tuple[Tensor, Tensor],
    seen: TrackPositions,
    frames: Tensor,
    rows: Tensor,
    index: Tensor,
    sq_dist: Tensor,
) -> tuple[Tensor, Tensor]:
    """Reprojection error [m, 2] in pixels and depth error [m] in standard deviations of the observations `rows`.

    `motion` is that of the B training frames `frames`. All frames go through one blend: frame b owns the control
    points b P to (b + 1) P.
    """
    B, P = len(frames), len(deformation.points)
    slot = torch.empty(len(seen.times), dtype=torch.int64)
    slot[frames] = torch.arange(B)
    track, frame = seen.track[rows], seen.frame[rows]
    weights = lbs.lbs_weights(sq_dist[track], deformation.log_radii, index[track])
    shifted = index[track] + P * slot[frame][:, None]
    quats, translations = motion
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(len(rows), 4)
    points = deformation.points.repeat(B, 1)
    means, _ = lbs.blend(
        seen.canonical[track], identity, points, quats.flatten(0, 1), translations.flatten(0, 1), weights, shifted
    )
    xyz = _to_camera(means, seen.cam_from_world[frame])
    observed = seen.depth[rows]
    # A point that crosses the camera plane keeps a finite projection; the depth term moves it back in front.
    z = torch.maximum(xyz[:, 2], 0.1 * observed)
    K = seen.Ks[frame]
    uv = xyz[:, :2] / z[:, None] * torch.stack([K[:, 0, 0], K[:, 1, 1]], dim=-1) + K[:, :2, 2]
    relative_std = seen.depth_std[rows].clamp_min(DEPTH_STD)
    return uv - seen.uv[rows], (xyz[:, 2] / observed - 1) / relative_std


def _all_residuals(deformation: Deformation, motion: tuple[Tensor, Tensor], seen: TrackPositions) -> Tensor:
    """Reprojection error [M, 2] in pixels of every observation, for the `motion` at all training frames."""
    index, sq_dist = lbs.neighbours(deformation.points, seen.canonical, NEIGHBOURS)
    frames, parts = torch.arange(len(seen.times)), torch.split(torch.arange(len(seen.track)), MOST_AT_ONCE)
    return torch.cat([_residuals(deformation, motion, seen, frames, rows, index, sq_dist)[0] for rows in parts])


def position_gradients(deformation: Deformation, seen: TrackPositions) -> Tensor:
    """Gradient [n, 3] of the image-plane loss over all observations by the canonical track positions."""
    positions = seen.canonical.clone().requires_grad_()
    with torch.no_grad():
        motion = deformation(seen.times)
    pixels = _all_residuals(deformation, motion, replace(seen, canonical=positions))
    loss = smooth_l1_loss(pixels, torch.zeros_like(pixels), reduction="sum")
    return torch.autograd.grad(loss, positions)[0]


def _to_camera(points: Tensor, cam_from_world: Tensor) -> Tensor:
    """Points [m, 3] in their cameras [m, 4, 4]."""
    return torch.einsum("mab,mb->ma", cam_from_world[:, :3, :3], points) + cam_from_world[:, :3, 3]


def residual_report(deformation: Deformation, seen: TrackPositions) -> dict[str, float | bool]:
    """Residuals of the tracks with the fitted motion and without motion, and whether the fit is stuck.

    Returns:
        median_px, p90_px: reprojection error in full-frame pixels; at_rest_px: the median error of unmoved points;
        stuck: whether the median is above STUCK_PX, or above both NOISE_PX and that of points at rest, or one in ten is
            above STUCK_P90_PX.
    """
    with torch.no_grad():
        quats, translations = deformation(seen.times)
        rest = (quats.new_tensor([1.0, 0.0, 0.0, 0.0]).expand_as(quats), torch.zeros_like(translations))
        errors = [
            _all_residuals(deformation, motion, seen).norm(dim=-1).numpy() for motion in ((quats, translations), rest)
        ]
    median, at_rest = (float(np.median(error)) for error in errors)
    p90 = float(np.quantile(errors[0], 0.9))
    return {
        "median_px": median,
        "p90_px": p90,
        "at_rest_px": at_rest,
        "stuck": bool(median > min(STUCK_PX, max(NOISE_PX, at_rest)) or p90 > STUCK_P90_PX),
    }
