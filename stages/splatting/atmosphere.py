"""Fog and haze: extinction and airlight between the camera and the Gaussians, whose own colours are free of fog.

A surface of linear radiance J at distance r shows as J t + A (1 - t) with t = exp(-b r) (Koschmieder 1924).
"""

import torch
from torch import Tensor

from stages.shared.images import DISPLAY_GAMMA

LEAST_RADIANCE = 1e-5
"""Radiances are no less: the slope of the display gamma is infinite at black."""
LEAST_SHOWN = 0.1
"""Least transmittance through which a colour is cleared of fog: below it noise is all that is left."""


class Atmosphere(torch.nn.Module):
    """Homogeneous fog, as it was measured on the static scene; not trained.

    Attributes:
        extinction: b > 0, 1 / scene unit. airlight: [3], A as linear radiance.
    """

    extinction: Tensor
    airlight: Tensor

    def __init__(self, extinction: float, airlight: Tensor) -> None:
        super().__init__()
        self.register_buffer("extinction", torch.tensor(float(extinction)))
        self.register_buffer("airlight", airlight.float())

    def forward(self, colours: Tensor, distance: Tensor) -> Tensor:
        """Gamma-encoded colours [N, 3] >= 0 as they show through the fog over distances [N] in scene units."""
        shown = torch.exp(-self.extinction * distance)[:, None]
        linear = colours.clamp_min(LEAST_RADIANCE ** (1 / DISPLAY_GAMMA)) ** DISPLAY_GAMMA
        veiled = linear * shown + self.airlight * (1 - shown)
        return veiled.clamp_min(LEAST_RADIANCE) ** (1 / DISPLAY_GAMMA)

    def cleared(self, colours: Tensor, distance: Tensor) -> Tensor:
        """The inverse, in 0..1: colours [N, 3] without the fog, as far as it lets them through."""
        shown = torch.exp(-self.extinction * distance)[:, None]
        linear = (colours.clamp_min(0.0) ** DISPLAY_GAMMA - self.airlight * (1 - shown)) / shown.clamp_min(LEAST_SHOWN)
        return linear.clamp(LEAST_RADIANCE, 1.0) ** (1 / DISPLAY_GAMMA)
