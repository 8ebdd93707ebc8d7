"""Density control: Gaussians with a large image gradient are split, transparent ones pruned, up to a hard cap."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from stages.gaussians import record_kernels
from stages.shared import quaternions
from stages.shared.threads import spread
from stages.splatting.cloud import Cloud, select

MIN_OPACITY = 0.01
"""Gaussians below this opacity are pruned: they change no pixel visibly."""
GROWTH = 0.05
"""At most this share of the Gaussians is split at a time."""
MIN_GRADIENT = 1.5
"""Gaussians are split if their mean image gradient exceeds this multiple of the average over all Gaussians."""


@dataclass
class GradientRecord:
    """Mean length of the gradient of the loss by the projected mean, over the steps in which a Gaussian was drawn.

    Attributes:
        total: [N] sum of the lengths, loss per px. views: [N] number of steps with a gradient.
    """

    total: Tensor
    views: Tensor

    @classmethod
    def empty(cls, N: int, device: torch.device) -> "GradientRecord":
        """A record of N Gaussians without any step."""
        return cls(torch.zeros(N, device=device), torch.zeros(N, device=device))

    def add(self, gradient: Tensor, rows: Tensor | None = None) -> None:
        """Add the gradient [1, M, 2] of one step, of the Gaussians in `rows` [M], all of them if None."""
        rows = torch.arange(len(self.total), device=gradient.device) if rows is None else rows
        if gradient.device.type != "cpu":
            length = gradient[0].norm(dim=-1)
            self.total.index_add_(0, rows, length)
            self.views.index_add_(0, rows, (length > 0).to(length))
            return
        given = (gradient[0], rows, self.total, self.views)
        spread(record_kernels.add, len(rows), *(values.contiguous().numpy() for values in given))

    @property
    def mean(self) -> Tensor:
        """Mean length [N]; zero for Gaussians that were never drawn."""
        return self.total / self.views.clamp_min(1)


def densify(cloud: Cloud, gradient: Tensor, max_gaussians: int, interval: float) -> tuple[Cloud, Tensor]:
    """Prune transparent Gaussians, then split those with the largest gradients along their longest axis.

    The halves are half a standard deviation of the parent to either side of its centre. Their longest axis is 0.5 times
    that of the parent, the other axes 0.85 times and the opacity 0.8 times; life spans are the parent's. No random
    numbers are used.

    Args:
        gradient: [N] mean gradient length of each Gaussian. max_gaussians: hard cap.
        interval: between training frames, in lengths of the clip.

    Returns:
        The new cloud of M Gaussians, static first, and the row [M] of each in the old cloud, -1 for halves.
    """
    alive = torch.nonzero(strength(cloud, interval) > MIN_OPACITY)[:, 0]
    room = max(0, min(int(GROWTH * len(alive)), max_gaussians - len(alive)))
    pulled = gradient[alive]
    wanted = int((pulled > MIN_GRADIENT * float(pulled.cpu().numpy().mean())).sum()) if len(alive) else 0
    chosen = alive[pulled.topk(min(room, wanted)).indices]
    is_chosen = torch.zeros_like(cloud.dynamic)
    is_chosen[chosen] = True
    kept = alive[~is_chosen[alive]]
    rows = torch.cat([kept, chosen, chosen])
    parents = torch.cat([kept, -torch.ones_like(chosen), -torch.ones_like(chosen)])
    grown = select(cloud, rows)
    _halve(grown, len(kept), len(chosen))
    order = torch.argsort(grown.dynamic.to(torch.uint8), stable=True)
    return select(grown, order), parents[order]


def strength(cloud: Cloud, interval: float) -> Tensor:
    """Largest opacity [N], times the number of training frames that it lasts where that is less than one.

    It lasts for sqrt(2 pi) spans, by the area under its curve. A Gaussian that is gone by the next frame is of use to
    its own alone, and leaves a hole between the two.

    Args:
        interval: between training frames, in lengths of the clip.
    """
    lasting = cloud.log_spans.exp() * (math.sqrt(2 * math.pi) / interval)
    return cloud.logits.sigmoid() * lasting.clamp_max(1)


def _halve(cloud: Cloud, start: int, count: int) -> None:
    """Turn the `count` rows from `start` on, and their copies in the next `count` rows, into the two halves of each."""
    for side, begin in ((1.0, start), (-1.0, start + count)):
        rows = slice(begin, begin + count)
        axis = cloud.log_scales[rows].argmax(dim=-1, keepdim=True)
        longest = cloud.log_scales[rows].gather(1, axis).exp()
        local = torch.zeros_like(cloud.means[rows]).scatter(1, axis, 0.5 * side * longest)
        rotations = quaternions.rotation_matrices(quaternions.normalise(cloud.quats[rows]))
        cloud.means[rows] += torch.einsum("nab,nb->na", rotations, local)
        shrink = torch.full_like(local, 0.85).scatter(1, axis, 0.5)
        cloud.log_scales[rows] += shrink.log()
        cloud.logits[rows] = (0.8 * cloud.logits[rows].sigmoid()).logit()
