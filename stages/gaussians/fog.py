"""Frames without the fog in front of what they show: the colours that Gaussians begin with."""

from dataclasses import replace

import numpy as np
import torch

from stages.gaussians.training_frames import TrainingFrames
from stages.shared.cameras import pixel_grid
from stages.shared.frame_store import Computed
from stages.splatting.atmosphere import Atmosphere


def cleared_of_fog(seen: TrainingFrames, air: Atmosphere) -> TrainingFrames:
    """The same frames with colours cleared of the fog up to the depth of each pixel."""
    uv = pixel_grid(*seen.size)

    def cleared(f: int) -> np.ndarray:
        image, K = seen.images[f], seen.Ks[f]
        rays = (uv - K[:2, 2]) / K[[0, 1], [0, 1]]
        distance = seen.depths[f] * np.sqrt(1 + np.square(rays).sum(axis=-1))
        colours, way = torch.as_tensor(image).reshape(-1, 3), torch.as_tensor(distance).float().ravel()
        return np.asarray(air.cleared(colours, way).reshape(image.shape).numpy())

    return replace(seen, images=Computed(len(seen.images), cleared))
