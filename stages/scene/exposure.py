"""Evidence for a change of exposure: a gain per frame, fitted jointly with the effect of fog on the same pixels.

Fog shows a surface of radiance J at distance r as I = J exp(-b r) + A (1 - exp(-b r)) (Koschmieder 1924). A step that
changes its distance by dr changes log I by -b dr (1 - A / I): as the camera approaches, surfaces brighter than the
airlight A become brighter and darker ones darker, near and far ones differently. A gain changes log I by the same
amount everywhere. In gamma-encoded colours both changes are divided by DISPLAY_GAMMA.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from stages.scene.geometry import MIN_CONFIDENCE
from stages.scene.observed import Observed
from stages.shared import lie
from stages.shared.cameras import pixel_grid, unproject
from stages.shared.warp import is_inside, warp

DARK, BRIGHT = 0.08, 0.92
"""Colours outside this range are clipped or mostly noise and do not determine a gain."""
DISPLAY_GAMMA = 2.2
SMOOTH_PX = 1.0
STRIDE_PX = 4
"""Sampling step each way: neighbouring pixels hold the same information."""
FARTHEST = 0.05
"""Share of the static pixels, the most distant ones, whose brightness is used as airlight."""
LEAST_SHOWN, LEAST_AIRLIGHT = 0.1, 0.01
"""Smallest transmittance of the fog, and smallest radiance of the airlight."""
REGIONS = 4
"""Parts of the image each way that are left out in turn to see how far the gain depends on them."""
IRLS_STEPS = 10
KERNEL = 2.0
"""Scale of the robust kernel in standard deviations of the noise, itself no less than LEAST_NOISE."""
LEAST_NOISE = 1e-4


@dataclass(frozen=True)
class Changes:
    """How n static pixels of F frames change from a frame to the next.

    Attributes:
        step: [n] the frame, 0..F - 2. ratio: [n] change of the logarithm of the brightness.
        farther: [n] change of distance in scene units. radiance: [n] linear, 0..1. region: [n] 0..REGIONS^2 - 1.
        near, far: [n] bool, at most and at least the median depth of the frame; both are true at equal depths.
        airlight: linear radiance of the most distant pixels; reach: their distance.
    """

    step: np.ndarray
    ratio: np.ndarray
    farther: np.ndarray
    radiance: np.ndarray
    region: np.ndarray
    near: np.ndarray
    far: np.ndarray
    airlight: float
    reach: float
    F: int


@dataclass(frozen=True)
class Gains:
    """Logarithmic gains [F] of the frames relative to the first, and what they were fitted with.

    Attributes:
        near, far: [F] the gains that near and far pixels show, fog aside.
        standard_error: of the range of the gains, from the variation between image regions and over airlights.
        extinction: b of the fog, 1 / scene unit, >= 0.
    """

    near: np.ndarray
    far: np.ndarray
    standard_error: float
    extinction: float

    @property
    def common(self) -> np.ndarray:
        """The part of the gain [F] that near and far pixels share."""
        smaller = np.minimum(np.abs(self.near), np.abs(self.far))
        return np.where(self.near * self.far > 0, np.sign(self.near) * smaller, 0.0)


def measure_gains(seen: Observed) -> Gains:
    """Gains of the training frames along the chain of neighbours; a step without an edge or pixels adds nothing."""
    changes = _changes(seen)
    best = _fit(changes, changes.airlight)
    others = [_fit(changes, airlight) for airlight in _bounds(changes, DISPLAY_GAMMA * best.extinction)]
    gains = _chain(best.steps)
    first, last = gains.argmin(), gains.argmax()
    left_out = np.stack([_chain(steps) for steps in best.left_out])
    ranges = left_out[:, last] - left_out[:, first]
    n = len(ranges)
    by_region = (n - 1) / n * ((ranges - ranges.mean()) ** 2).sum()  # jackknife (Efron 1982)
    by_airlight = max((np.ptp(_chain(fit.steps)) - np.ptp(gains)) ** 2 for fit in others)
    clear = changes.ratio - best.extinction * _fog(changes, changes.airlight)
    near, far = (_chain(_medians(changes.step[part], clear[part], changes.F)) for part in (changes.near, changes.far))
    return Gains(near, far, float(np.sqrt(by_region + by_airlight)), DISPLAY_GAMMA * best.extinction)


def exposure_evidence(gains: Gains) -> dict[str, float]:
    """Ranges of the brightness over the clip, in per cent: of what near and far pixels share, and of each."""

    def percent(logs: np.ndarray) -> float:
        return 100 * float(np.expm1(np.ptp(logs)))

    return {
        "gain_range_percent": percent(gains.common),
        "near_range_percent": percent(gains.near),
        "far_range_percent": percent(gains.far),
        "standard_error_percent": 100 * gains.standard_error,
        "fog_extinction": gains.extinction,
    }


@dataclass(frozen=True)
class _Fit:
    """Change of the gain per step [F - 1], the same without each region [REGIONS^2, F - 1], and b / DISPLAY_GAMMA."""

    steps: np.ndarray
    left_out: np.ndarray
    extinction: float


def _changes(seen: Observed) -> Changes:
    F = len(seen.rgb)
    grey = np.stack([cv2.GaussianBlur(image.mean(axis=-1), (0, 0), SMOOTH_PX) for image in seen.rgb])
    row_of = {tuple(edge): row for row, edge in enumerate(seen.edges.tolist())}
    rows = [(k, row_of[k, k + 1]) for k in range(F - 1) if (k, k + 1) in row_of]
    parts = [_step_changes(seen, grey, k, row) for k, row in rows] or [(np.zeros(0),) * 7]
    step, ratio, farther, radiance, region, near, far = (np.concatenate(part) for part in zip(*parts, strict=True))
    airlight, reach = _airlight(seen, grey)
    whole = step.astype(int), region.astype(int)
    return Changes(
        whole[0], ratio, farther, radiance, whole[1], near.astype(bool), far.astype(bool), airlight, reach, F
    )


def _step_changes(seen: Observed, grey: np.ndarray, k: int, row: int) -> tuple[np.ndarray, ...]:
    """The arrays of `Changes` from frame k to the next, along the edge of this row; grey [F, h, w] in 0..1."""
    h, w = grey.shape[1:]
    v, u = np.mgrid[:h, :w]
    here, there = grey[k], warp(grey[k + 1], seen.flow[row])
    good = (seen.confidence[row] >= MIN_CONFIDENCE) & ~seen.dynamic[k] & is_inside(seen.flow[row])
    good &= (np.minimum(here, there) > DARK) & (np.maximum(here, there) < BRIGHT)
    good &= (v % STRIDE_PX == 0) & (u % STRIDE_PX == 0)
    here, there, depth = here[good], there[good], seen.depth[k][good]
    points = unproject(pixel_grid(h, w)[good], depth, seen.cam_from_world[k], seen.Ks[k])
    before, after = lie.inverse(seen.cam_from_world[k : k + 2])[:, :3, 3]
    farther = np.linalg.norm(points - after, axis=1) - np.linalg.norm(points - before, axis=1)
    # Of both ends, so that the noise of one end does not make its ratio and its radiance vary together.
    radiance = np.sqrt(here * there) ** DISPLAY_GAMMA
    region = ((REGIONS * v // h) * REGIONS + REGIONS * u // w)[good]
    middle = np.median(depth) if len(depth) else 0.0
    halves = depth <= middle, depth >= middle
    return np.full(len(here), k), np.log(there / here), farther, radiance, region, *halves


def _airlight(seen: Observed, grey: np.ndarray) -> tuple[float, float]:
    """Linear radiance of the most distant static pixels, and their distance; grey [F, h, w] in 0..1."""
    found = []
    for image, depth, dynamic in zip(grey, seen.depth, seen.dynamic, strict=True):
        if not dynamic.all():
            farthest = ~dynamic & (depth >= np.quantile(depth[~dynamic], 1 - FARTHEST))
            found.append((float(np.median(image[farthest])), float(np.median(depth[farthest]))))
    brightness, reach = np.median(found, axis=0) if found else (1.0, 1.0)
    return float(brightness) ** DISPLAY_GAMMA, float(reach)


def _bounds(changes: Changes, extinction: float) -> tuple[float, float]:
    """The darkest and the brightest airlight that the most distant pixels allow.

    Through fog of this extinction a share of their surface still shows, which is black, or twice as bright as they are.
    """
    shown = max(float(np.exp(-extinction * changes.reach)), LEAST_SHOWN)
    lowest = changes.airlight * (1 - 2 * shown) / max(1 - shown, LEAST_SHOWN)
    highest = changes.airlight / max(1 - shown, LEAST_SHOWN)
    return max(lowest, LEAST_AIRLIGHT), min(highest, 1.0)


def _fog(changes: Changes, airlight: float) -> np.ndarray:
    """Change [n] of the logarithm of the brightness by fog of unit extinction, in linear radiance."""
    return -changes.farther * (1 - airlight / changes.radiance)


def _fit(changes: Changes, airlight: float) -> _Fit:
    """Gains per step and one extinction that explain the changes best, robustly (Geman-McClure, by reweighting)."""
    y, z = changes.ratio, _fog(changes, airlight)
    shape = REGIONS**2, changes.F - 1
    cell = changes.region * shape[1] + changes.step
    gain, extinction = _medians(changes.step, y, changes.F), 0.0

    def sums(values: np.ndarray) -> np.ndarray:
        return np.bincount(cell, values, shape[0] * shape[1]).reshape(shape)

    for _ in range(IRLS_STEPS):
        residual = y - gain[changes.step] - extinction * z
        noise = max(1.4826 * float(np.median(np.abs(residual))) if len(y) else 0.0, LEAST_NOISE)
        weight = 1 / (1 + (residual / (KERNEL * noise)) ** 2) ** 2
        parts = [sums(weight * values) for values in (np.ones_like(y), z, y, z * z, z * y)]
        gain, extinction = _solve([part.sum(axis=0) for part in parts])
    left_out = [_solve([part.sum(axis=0) - part[region] for part in parts])[0] for region in range(shape[0])]
    return _Fit(gain, np.stack(left_out), extinction)


def _solve(sums: list[np.ndarray]) -> tuple[np.ndarray, float]:
    """Gains [F - 1] and extinction >= 0 from sums [F - 1] of weights times 1, z, y, z z, z y: the gains eliminated."""
    count, z, y, zz, zy = sums
    count = np.maximum(count, 1e-12)
    scatter = float((zz - z * z / count).sum())
    extinction = max(float((zy - z * y / count).sum()) / scatter, 0.0) if scatter > 1e-12 else 0.0
    return (y - z * extinction) / count, extinction


def _medians(step: np.ndarray, values: np.ndarray, F: int) -> np.ndarray:
    """Median of the values [n] of each of F - 1 steps; 0 where there are none."""
    chosen = [values[step == k] for k in range(F - 1)]
    return np.array([np.median(part) if len(part) else 0.0 for part in chosen])


def _chain(steps: np.ndarray) -> np.ndarray:
    """Sums [F] of changes per step [F - 1], 0 for the first frame."""
    return np.concatenate([[0.0], np.cumsum(steps)])
