"""Frames that movers are lifted from, how densely, and the life spans of their Gaussians around these frames."""

from dataclasses import replace

import numpy as np
import torch

from stages.splatting.cloud import Cloud
from stages.splatting.life_spans import ALWAYS

SPAN_SHARE = 0.75
"""Initial life span as a share of the time between two frames that movers are lifted from."""


def birth_frames(masked: np.ndarray, every: int, room: int) -> list[int]:
    """Indices of the frames that movers are lifted from: about one in `every` of F, evenly spread, with both ends.

    As long as these have more masked pixels [F] than there is `room` for, one in more is taken, up to twice `every`:
    of movers lifted half as often less is lost than of a whole scene that is lifted more coarsely.
    """
    F = len(masked)
    for gap in range(every, 2 * every + 1):
        chosen = np.unique(np.linspace(0, F - 1, 1 + max(1, round((F - 1) / gap))).round().astype(int))
        if masked[chosen].sum() <= room:
            break
    return [int(f) for f in chosen]


def movers_stride(masked: np.ndarray, births: list[int], stride_px: int, room: int) -> int:
    """Distance in px, each way, between lifted pixels of movers with life spans: one px less than `stride_px`.

    A pixel of a mover is lifted in few frames, and trained in those around them alone: the steps in which a static one
    sharpens are many times as many. At a stride of 2 instead of 3 held-out movers of exposure_drift gain 0.6 dB in 400
    steps, of orbit_two and fast_chase 0.3; those of glossy_zoom lose 0.05, and of the demo, whose 12 frames are trained
    33 times each, 0.3. Where the masked pixels [F] of the births would take more than three quarters of the `room`,
    densification would have little left: `stride_px`.
    """
    finer = max(1, stride_px - 1)
    return finer if masked[births].sum() <= finer**2 * room * 3 // 4 else stride_px


def with_life_spans(cloud: Cloud, frames: np.ndarray, times: np.ndarray, births: list[int]) -> Cloud:
    """The cloud with life spans of its dynamic Gaussians, around the frames [N] that they were lifted from.

    Args:
        times: [F] of the frames. births: indices of the frames that movers are lifted from; none: no life spans.
    """
    if not births:
        return cloud
    gap = birth_gap(times, births)
    spans = torch.full_like(cloud.logits, float(np.log(SPAN_SHARE * gap)))
    log_spans = torch.where(cloud.dynamic, spans, torch.full_like(spans, ALWAYS))
    return replace(cloud, births=torch.as_tensor(times[frames], dtype=torch.float32), log_spans=log_spans)


def birth_gap(times: np.ndarray, births: list[int]) -> float:
    """Mean time between two of the frames `births` that movers are lifted from, of frames at times [F]."""
    return float(np.mean(np.diff(times[births])))
