"""The unknowns of bundle adjustment, which of them are free, and what is known beforehand."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

DEPTH_PRIOR = 1e-4
"""Weight, px^2, of the prior that an inverse depth is the median 1: far below the weight of one useful match."""
FLOW_VARIANCE = 1.5
"""Variance of a match, px^2, relative to which the focal length prior is weighted."""
QUIET_PX = 0.12
"""Robust scale, px, below which the priors on depths and on the focal length fall with its square: it is twice the
noise, whose variance is then less than FLOW_VARIANCE, and a narrower kernel leaves less of the data to hold against
priors that stay as they are. On a straight path, where depths make up for most of a focal length, these drew it by 5 %
at a scale of .05 px."""
ZOOM_BEND = 0.02
"""Standard deviation of the second differences of the log focal over frames, relative to flow errors as they are: alike
over many pixels (a lens that starts to double its focal length within a second bends it by 0.03 in one frame)."""
SMOOTHNESS = FLOW_VARIANCE / ZOOM_BEND**2
"""Weight of the prior that the log focals have no second differences, px^2."""
LENS_PRIOR = FLOW_VARIANCE / 0.3**2
"""Weight of the prior that a lens has no distortion: the standard deviation is 0.3 of the way to a corner."""
INVERSE_DEPTHS = (1e-4, 20.0)
"""Range of inverse depths, relative to their median."""
BEYOND_INFINITY = -0.01
"""The least inverse depth in steps once movers are masked. At 0 noise at infinity goes one way and draws the cameras.
At -0.05 depths beyond infinity make up for a zoom of 1.15 of a camera that goes ahead."""


def prior_share(sigma_px: float) -> float:
    """Share of their weight that the priors on depths and on the focal length have at a robust scale in px."""
    return min(1.0, (sigma_px / QUIET_PX) ** 2)


@dataclass(frozen=True)
class State:
    """The unknowns of bundle adjustment. The gauge: first pose identity, median inverse depth 1.

    Attributes:
        cam_from_world: [T, 4, 4].
        inverse_depth: [T, P], of the pixels of the graph.
        focal_px: focal length on the flow grid, of all frames or their geometric mean.
        zoom: [T] focal length of each frame over `focal_px`; None: all have the same.
        lens: [2] c1 and c2 of the distortion q (1 + c1 s + c2 s^2) of a pixel q about the centre, with s = |q|^2 over
            that of a corner of the image; None: a pinhole.
    """

    cam_from_world: np.ndarray
    inverse_depth: np.ndarray
    focal_px: float
    zoom: np.ndarray | None = None
    lens: np.ndarray | None = None

    @property
    def focals_px(self) -> np.ndarray:
        """Focal length [T] of every frame."""
        return self.focal_px * (np.ones(len(self.cam_from_world)) if self.zoom is None else self.zoom)


@dataclass(frozen=True)
class Unknowns:
    """Which unknowns are free. Without translation the depths are unobservable and stay as they are.

    With `zoom`, which includes `focal`, every frame has a focal length of its own. `lens` is the number of free
    coefficients of a lens that has them.
    """

    focal: bool = False
    translation: bool = True
    zoom: bool = False
    lens: int = 0

    def indices(self, T: int) -> np.ndarray:
        """Indices of the free unknowns among (twists of T poses, log focals, lens); the first pose is fixed."""
        twists = np.arange(6, 6 * T).reshape(-1, 6)[:, 0 if self.translation else 3 :]
        focals = np.arange(6 * T, 7 * T) if self.zoom else [6 * T] if self.focal else []
        lens = (7 * T if self.zoom else 6 * T + 1) + np.arange(self.lens)
        return np.concatenate([twists.ravel(), focals, lens]).astype(int)


@dataclass(frozen=True)
class FocalPrior:
    """Log-normal prior of the focal length: centre in px and standard deviation of the logarithm.

    It is one of the mean over the frames where each has its own, whose curve is smooth besides: `ZOOM_BEND`.
    """

    focal_px: float
    log_sigma: float = 0.35

    @property
    def weight(self) -> float:
        """Curvature in units of px^2 of flow error."""
        return FLOW_VARIANCE / self.log_sigma**2

    def at(self, sigma_px: float) -> "FocalPrior":
        """The prior as it is weighted at a robust scale in px."""
        return replace(self, log_sigma=self.log_sigma / prior_share(sigma_px) ** 0.5)

    def cost(self, apart: np.ndarray) -> float:
        """Cost of log focals, 1 or one per frame, that are `apart` [n] from the centre, px^2."""
        mean = float(apart.mean())
        return mean * self.weight * mean + float((SMOOTHNESS * np.diff(apart, 2) ** 2).sum())


class Level(NamedTuple):
    """One stage of the graduated robust kernel: its scale in px and its largest number of iterations.

    It ends early at a step that lowers the cost by less than the relative amount `gain`.
    """

    sigma_px: float
    iterations: int
    gain: float = 1e-5


@dataclass(frozen=True)
class Step:
    """One iteration, as `ba/convergence.parquet` shows it."""

    phase: str
    sigma_px: float
    cost: float
    step: float
    damping: float
    focal_px: float
    accepted: bool
    seconds: float
