"""The cameras and the depth of the round before, on the grid of the flow."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from stages.shared import cameras
from stages.shared.cameras import Cameras


class StaticWorld(NamedTuple):
    """Cameras of the round before, with intrinsics [T, 3, 3] of the flow grid, and what gives inverse depth [h, w]; and
    what gives `RollingShutter.projection` where the rows of a frame are exposed in turn."""

    cameras: Cameras
    Ks: np.ndarray
    inverse_depth: Callable[[int], np.ndarray]
    of_rows: Callable[[int, int], tuple[np.ndarray, np.ndarray]] | None = None

    def observed(self, i: int, j: int) -> bool:
        """Whether the cameras of both frames were found."""
        return "unobserved" not in self.cameras.status[[i, j]]

    def projection(self, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        """`cameras.projection` of pixels of frame i into frame j, or that of every row."""
        if self.of_rows:
            return self.of_rows(i, j)
        source, target = ((self.cameras.cam_from_world[k], self.Ks[k]) for k in (i, j))
        return cameras.projection(source, target)
