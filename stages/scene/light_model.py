"""How the colour of a static point changes between frames: what the models of light predict, and its derivatives.

    log I = gain of the frame (and channel) + vignetting * off_axis + log(J t + A (1 - t)) / DISPLAY_GAMMA

Fog shows a surface of linear radiance J at distance r through transmittance t = exp(-b r) and adds the airlight A
(Koschmieder 1924). In gamma-encoded colours I a gain is a factor. Every model has the vignetting, which moves with the
picture and is otherwise taken for a gain, and the radiances J of the points. The unknowns of fog are b and b A, in
which thin fog is linear.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stages.scene.sightings import Sightings
from stages.shared.images import DISPLAY_GAMMA

FARTHEST = 0.1
"""Share of the points whose colour is the first guess of the airlight."""
LEAST_RADIANCE, MOST_RADIANCE = 1e-4, 10.0
SELDOM = 1 / 3
"""Where no point is seen in more than this share of the frames, as in a long clip, each keeps its frames alone."""


class Model(NamedTuple):
    """Which changes a model knows: `gains` per frame 0: none, 1: one, 3: one per channel; and fog."""

    gains: int
    fog: bool


@dataclass(frozen=True)
class Light:
    """Parameters of a model.

    Attributes:
        log_gains: [F, 3]. vignetting: of the log colours in the corners. extinction: b, 1 / scene unit.
        scattered: [3], b A: linear radiance that a scene unit of fog adds.
    """

    log_gains: np.ndarray
    vignetting: float
    extinction: float
    scattered: np.ndarray

    @property
    def airlight(self) -> np.ndarray:
        """Linear radiance [3] of the fog at infinity; 0 without fog."""
        return self.scattered / self.extinction if self.extinction > 0 else np.zeros(3)


def no_light(F: int) -> Light:
    """The light that changes nothing."""
    return Light(np.zeros((F, 3)), 0.0, 0.0, np.zeros(3))


class State(NamedTuple):
    """The parameters, and the linear radiances [n, 3] of the points without fog."""

    light: Light
    radiance: np.ndarray


class Points:
    """The n points that a model is fitted to, of F frames in the S in which each of them is seen, or in all.

    Attributes:
        F: number of frames. frame: [n, S] the frames of each point, ascending, or [1, F] of all points.
        sparse: whether `frame` leaves frames out.
        colours, usable, logs: [n, 3, S]: sums over the sightings of a point run along memory. distance, off_axis:
            [n, 1, S]. unit: median distance.
    """

    def __init__(self, seen: Sightings, rows: np.ndarray) -> None:
        self.F, usable = seen.colours.shape[1], seen.usable[rows]
        self.frame = frames_of(usable.any(axis=2))
        self.sparse = self.frame.shape[1] < self.F

        def sighted(values: np.ndarray) -> np.ndarray:
            kept = values[np.arange(len(values))[:, None], self.frame] if self.sparse else values
            return np.ascontiguousarray(np.swapaxes(kept, 1, 2))

        self.colours, self.usable = sighted(seen.colours[rows]), sighted(usable)
        self.logs = np.log(np.maximum(self.colours, np.float32(1e-3)))
        self.distance, self.off_axis = (sighted(part[rows][..., None]) for part in (seen.distance, seen.off_axis))
        self.unit = float(np.median(seen.distance[rows])) if len(usable) else 1.0
        self.reach, self.far_radiance = self._farthest()

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Values [n, 3, S] as [n, F, 3], 0 in the frames that are left out."""
        values = np.swapaxes(values, 1, 2)
        if not self.sparse:
            return values
        table = np.zeros((len(values), self.F, values.shape[2]), values.dtype)
        table[np.arange(len(values))[:, None], self.frame] = values
        return table

    def _farthest(self) -> tuple[float, np.ndarray]:
        """Median distance and linear radiance [3] of the most distant sightings; their medians where there are none."""
        seen = self.usable.all(axis=1)
        if not seen.any():
            return self.unit, np.full(3, 0.5)
        distance, colours = self.distance[:, 0][seen], np.swapaxes(self.colours, 1, 2)[seen]
        far = distance >= np.quantile(distance, 1 - FARTHEST)
        return float(np.median(distance[far])), np.median(colours[far], axis=0).astype(float) ** DISPLAY_GAMMA

    def least_airlight(self, extinction: float) -> np.ndarray:
        """The darkest airlight [3] that the most distant points allow, whose surfaces are at most twice as bright.

        Black fog would be a gain that grows as the camera approaches.
        """
        shown = float(np.exp(-extinction * self.reach))
        return np.asarray(self.far_radiance * max(1 - 2 * shown, 0.0) / max(1 - shown, LEAST_RADIANCE))

    def level(self, light: Light) -> np.ndarray:
        """Gains and vignetting [n or 1, 3, S] of a light, of the log colours."""
        gains = np.swapaxes(light.log_gains[self.frame], 1, 2)
        return np.asarray(gains + light.vignetting * self.off_axis, np.float32)

    def mean_radiance(self, light: Light) -> np.ndarray:
        """Linear radiance [n, 3] behind the fog of the mean colour of each point."""
        count = np.maximum(self.usable.sum(axis=2), 1)
        shown = np.where(self.usable, np.exp(DISPLAY_GAMMA * (self.logs - self.level(light))), 0.0).sum(axis=2) / count
        clear, scattering = fog_over(light, self.distance)
        seen_through, added = (np.where(self.usable, part, 0.0).sum(axis=2) / count for part in (clear, scattering))
        veiled = shown - light.scattered * added
        return brightened(np.maximum(veiled, LEAST_RADIANCE) / np.maximum(seen_through, LEAST_RADIANCE), np.zeros(1))


def frames_of(seen: np.ndarray) -> np.ndarray:
    """The frames [n, S] in which points are seen [n, F] bool, and S > 0 of each; all of them [1, F] unless SELDOM."""
    F = seen.shape[1]
    S = max(int(seen.sum(axis=1).max(initial=0)), 1)
    if S > SELDOM * F:
        return np.arange(F)[None]
    return np.sort(np.argsort(~seen, axis=1, kind="stable")[:, :S], axis=1)


def fog_over(light: Light, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Transmittance t over distances [...], and the integral (1 - t) / b of it, which is the distance where b is 0."""
    optical = (light.extinction * distance).astype(distance.dtype)
    filled = np.where(optical > 1e-6, -np.expm1(-optical) / np.maximum(optical, 1e-6), 1 - optical / 2)
    return np.exp(-optical), distance * filled


def linear_radiance(of: Points, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Transmittance [n, 1, S], its integral [n, 1, S], and the linear radiance [n, 3, S] > 0 that is seen."""
    clear, scattering = fog_over(state.light, of.distance)
    surface = state.radiance[..., None].astype(np.float32) * clear
    shown = surface + state.light.scattered[:, None].astype(np.float32) * scattering
    return clear, scattering, np.maximum(shown, np.float32(LEAST_RADIANCE))  # the sky behind black fog is black


def errors_of(of: Points, state: State) -> np.ndarray:
    """Errors [n, 3, S] of the logarithms of the colours."""
    foggy = state.light.extinction > 0
    shown = linear_radiance(of, state)[2] if foggy else state.radiance[..., None].astype(np.float32)
    return np.asarray(of.logs - of.level(state.light) - np.log(shown) / np.float32(DISPLAY_GAMMA))


def slopes_of(of: Points, state: State) -> np.ndarray:
    """Derivatives [n, 3, S] of the log colours by the log radiances."""
    if state.light.extinction == 0:
        return np.full(of.colours.shape, 1 / DISPLAY_GAMMA, np.float32)
    clear, _, linear = linear_radiance(of, state)
    return np.asarray(state.radiance[..., None].astype(np.float32) * clear / linear / np.float32(DISPLAY_GAMMA))


def derivatives(of: Points, model: Model, state: State) -> list[np.ndarray]:
    """Derivatives [n, 3, S] of the log colours by vignetting, and by b and b A [3] over the median distance."""
    extras = [np.broadcast_to(of.off_axis, of.colours.shape)]
    if model.fog:
        clear, scattering, linear = linear_radiance(of, state)
        b, r, scale = state.light.extinction, of.distance, of.unit * DISPLAY_GAMMA * linear
        # d scattering / d b = (r t - (1 - t) / b) / b, which is -r^2 / 2 where b is 0
        bent = (r * clear - scattering) / b if b * of.unit > 1e-3 else -r * r / 2
        by_b = -r * clear * state.radiance[..., None] + bent * state.light.scattered[:, None]
        extras.append((by_b / scale).astype(np.float32))
        extras += [(scattering / scale * channel[:, None]).astype(np.float32) for channel in np.eye(3)]
    return extras


def brightened(radiance: np.ndarray, step: np.ndarray) -> np.ndarray:
    return np.asarray(np.clip(radiance * np.exp(np.clip(step, -1, 1)), LEAST_RADIANCE, MOST_RADIANCE))


def cleared(seen: Sightings, light: Light) -> np.ndarray:
    """Colours [n, F, 3] of the points as they would be without gains, vignetting and fog."""
    shown = seen.colours / np.exp(light.log_gains + light.vignetting * seen.off_axis[..., None])
    clear = fog_over(light, seen.distance[..., None])[0]
    veiled = shown**DISPLAY_GAMMA - light.airlight * (1 - clear)
    linear = veiled / np.maximum(clear, LEAST_RADIANCE)  # of the sky behind dense fog nothing is left
    return np.asarray(np.maximum(linear, LEAST_RADIANCE) ** (1 / DISPLAY_GAMMA), np.float32)
