"""The Gaussians of a scene: their unconstrained parameters, one row per Gaussian."""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from stages.splatting.life_spans import ALWAYS


@dataclass
class Cloud:
    """N Gaussians, parametrised without constraints.

    Attributes:
        means: [N, 3] canonical, scene units.
        footprints: [N] scene units, distance of neighbouring lifted pixels; the unit of the learning rate of means.
        log_scales: [N, 3] logarithms of the standard deviations in scene units.
        quats: [N, 4] wxyz, any length but zero. logits: [N] of opacity.
        sh: [N, K, 3] coefficients, K = (degree + 1)^2. dynamic: [N] bool, static Gaussians first.
        births, log_spans: [N] life spans, as for `life_spans.presence`; ALWAYS where static, and where left out.
        drifts: [N, 3] motion of the canonical means, scene units per span; they are at `means` at their birth.
    """

    means: Tensor
    footprints: Tensor
    log_scales: Tensor
    quats: Tensor
    logits: Tensor
    sh: Tensor
    dynamic: Tensor
    births: Tensor = field(default_factory=lambda: torch.zeros(0))
    log_spans: Tensor = field(default_factory=lambda: torch.zeros(0))
    drifts: Tensor = field(default_factory=lambda: torch.zeros(0))

    def __post_init__(self) -> None:
        """Without life spans Gaussians are there at all times, and do not drift."""
        if len(self.log_spans) == 0:
            self.births = torch.zeros_like(self.logits)
            self.log_spans = torch.full_like(self.logits, ALWAYS)
        if len(self.drifts) == 0:
            self.drifts = torch.zeros_like(self.means)


def select(cloud: Cloud, rows: Tensor) -> Cloud:
    """The Gaussians of a cloud with the indices `rows` [M], copied."""
    return Cloud(*(values[rows] for values in vars(cloud).values()))
