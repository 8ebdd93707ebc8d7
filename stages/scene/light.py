"""Models of how the colour of a static point changes between frames, and their fit.

    log I = gain of the frame (and channel) + vignetting * off_axis + log(J t + A (1 - t)) / DISPLAY_GAMMA

Fog shows a surface of linear radiance J at distance r through transmittance t = exp(-b r) and adds the airlight A
(Koschmieder 1924). In gamma-encoded colours I a gain is a factor. Every model has the vignetting, which moves with the
picture and is otherwise taken for a gain, and the radiances J of the points, which are eliminated. The unknowns of fog
are b and b A, in which thin fog is linear.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from stages.scene.sightings import Sightings
from stages.shared.images import DISPLAY_GAMMA

ITERATIONS, FOG_ITERATIONS, EVALUATIONS = 5, 10, 3
KERNEL = 3.0
"""Scale of the robust kernel in standard deviations of the noise, itself no less than LEAST_NOISE."""
LEAST_NOISE = 1e-3
DAMPING = 1e-6
"""Of the normal equations, as a share of their mean diagonal: holds gains of frames that see nothing."""
TRUST, TRUST_FACTOR = 1e-3, 10.0
"""First damping of the unknowns of fog (Levenberg-Marquardt), and the factor by which it changes."""
MOST_AIRLIGHT = 1.5
MOST_EXTINCTION = 5.0
"""Per median distance: less than a hundredth of the light is left."""
FIRST_EXTINCTIONS = (0.1, 0.7)
"""Where the search begins, per median distance, with the colour of the FARTHEST share of the points as airlight."""
FARTHEST = 0.1
LEAST_RADIANCE, MOST_RADIANCE = 1e-4, 10.0


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


def fit(seen: Sightings, model: Model, rows: np.ndarray, start: Light) -> Light:
    """The parameters of a model that explain the points `rows` [n] bool best (Gauss-Newton, Geman-McClure weights).

    Args:
        start: where to begin: parameters of this model or of one that it contains.
    """
    of = _Data(seen, rows)
    if not of.usable.any():
        return start
    if not model.fog:
        return _improved(of, model, _State(start, of.mean_radiance(start)), ITERATIONS).light
    starts = [start]
    if start.extinction == 0:
        thick = [extinction / of.unit for extinction in FIRST_EXTINCTIONS]
        starts = [replace(start, extinction=b, scattered=b * of.far_radiance) for b in thick]
    states = [_improved(of, model, _State(light, of.mean_radiance(light)), ITERATIONS) for light in starts]
    noise = min(_noise(of, _errors(of, state)) for state in states)
    best = min(states, key=lambda state: _cost(of, _errors(of, state), noise))
    return _improved(of, model, best, FOG_ITERATIONS).light


def _improved(of: "_Data", model: Model, state: "_State", iterations: int) -> "_State":
    """The parameters after so many steps; with fog, in which they are not linear, only steps that help are made."""
    trust = TRUST
    for _ in range(iterations):
        error = _errors(of, state)
        noise = _noise(of, error)
        moved = _step(of, model, state, error, noise, trust)
        if model.fog and _cost(of, _errors(of, moved), noise) > _cost(of, error, noise):
            trust *= TRUST_FACTOR
            continue
        state, trust = moved, trust / TRUST_FACTOR
    return state


def residuals(seen: Sightings, light: Light, rows: np.ndarray) -> np.ndarray:
    """Errors [m, F, 3] of the colours of the points `rows`, 0..1, each with its own best radiance; 0 where unusable."""
    of = _Data(seen, rows)
    state = _State(light, of.mean_radiance(light))
    for _ in range(EVALUATIONS):
        error = _errors(of, state)
        slope = _slopes(of, state)
        weight = _weights(of, error, _noise(of, error))
        state = _State(light, _brightened(state.radiance, _radiance_step(weight, slope, error)))
    return np.asarray(np.where(of.usable, of.colours * -np.expm1(-_errors(of, state)), 0.0))


def cleared(seen: Sightings, light: Light) -> np.ndarray:
    """Colours [n, F, 3] of the points as they would be without gains, vignetting and fog."""
    shown = seen.colours / np.exp(light.log_gains + light.vignetting * seen.off_axis[..., None])
    clear = _fog(light, seen.distance[..., None])[0]
    linear = (shown**DISPLAY_GAMMA - light.airlight * (1 - clear)) / clear
    return np.asarray(np.maximum(linear, LEAST_RADIANCE) ** (1 / DISPLAY_GAMMA), np.float32)


class _State(NamedTuple):
    """The parameters, and the linear radiances [n, 3] of the points without fog."""

    light: Light
    radiance: np.ndarray


class _Data:
    """The points that a model is fitted to; `unit` is their median distance."""

    def __init__(self, seen: Sightings, rows: np.ndarray) -> None:
        self.colours, self.usable = seen.colours[rows], seen.usable[rows]
        self.logs = np.log(np.maximum(self.colours, np.float32(1e-3)))
        self.distance, self.off_axis = seen.distance[rows][..., None], seen.off_axis[rows][..., None]
        self.unit = float(np.median(self.distance)) if len(self.distance) else 1.0
        self.reach, self.far_radiance = self._farthest()

    def _farthest(self) -> tuple[float, np.ndarray]:
        """Median distance and linear radiance [3] of the most distant sightings; their medians where there are none."""
        seen = self.usable.all(axis=2)
        if not seen.any():
            return self.unit, np.full(3, 0.5)
        distance, colours = self.distance[..., 0][seen], self.colours[seen]
        far = distance >= np.quantile(distance, 1 - FARTHEST)
        return float(np.median(distance[far])), np.median(colours[far], axis=0).astype(float) ** DISPLAY_GAMMA

    def least_airlight(self, extinction: float) -> np.ndarray:
        """The darkest airlight [3] that the most distant points allow, whose surfaces are at most twice as bright.

        Black fog would be a gain that grows as the camera approaches.
        """
        shown = float(np.exp(-extinction * self.reach))
        return np.asarray(self.far_radiance * max(1 - 2 * shown, 0.0) / max(1 - shown, LEAST_RADIANCE))

    def mean_radiance(self, light: Light) -> np.ndarray:
        """Linear radiance [n, 3] behind the fog of the mean colour of each point."""
        count = np.maximum(self.usable.sum(axis=1), 1)
        level = (light.log_gains + light.vignetting * self.off_axis).astype(np.float32)
        shown = np.where(self.usable, np.exp(DISPLAY_GAMMA * (self.logs - level)), 0.0).sum(axis=1) / count
        clear, scattering = _fog(light, self.distance)
        seen_through, added = (np.where(self.usable, part, 0.0).sum(axis=1) / count for part in (clear, scattering))
        veiled = shown - light.scattered * added
        return _brightened(np.maximum(veiled, LEAST_RADIANCE) / np.maximum(seen_through, LEAST_RADIANCE), np.zeros(1))


def _fog(light: Light, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Transmittance t over distances [...], and the integral (1 - t) / b of it, which is the distance where b is 0."""
    optical = (light.extinction * distance).astype(distance.dtype)
    filled = np.where(optical > 1e-6, -np.expm1(-optical) / np.maximum(optical, 1e-6), 1 - optical / 2)
    return np.exp(-optical), distance * filled


def _linear(of: _Data, state: _State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Transmittance [n, F, 1], its integral [n, F, 1], and the linear radiance [n, F, 3] > 0 that is seen."""
    clear, scattering = _fog(state.light, of.distance)
    surface = state.radiance[:, None].astype(np.float32) * clear
    shown = surface + state.light.scattered.astype(np.float32) * scattering
    return clear, scattering, np.maximum(shown, np.float32(LEAST_RADIANCE))  # the sky behind black fog is black


def _errors(of: _Data, state: _State) -> np.ndarray:
    """Errors [n, F, 3] of the logarithms of the colours."""
    level = (state.light.log_gains + state.light.vignetting * of.off_axis).astype(np.float32)
    shown = _linear(of, state)[2] if state.light.extinction > 0 else state.radiance[:, None].astype(np.float32)
    return np.asarray(of.logs - level - np.log(shown) / np.float32(DISPLAY_GAMMA))


def _slopes(of: _Data, state: _State) -> np.ndarray:
    """Derivatives [n, F, 3] of the log colours by the log radiances."""
    if state.light.extinction == 0:
        return np.full(of.colours.shape, 1 / DISPLAY_GAMMA, np.float32)
    clear, _, linear = _linear(of, state)
    return np.asarray(state.radiance[:, None].astype(np.float32) * clear / linear / np.float32(DISPLAY_GAMMA))


def _noise(of: _Data, error: np.ndarray) -> float:
    """Standard deviation of the errors of the colours, robustly."""
    shown = np.abs(of.colours * error)[of.usable]
    return max(1.4826 * float(np.median(shown)), LEAST_NOISE) if len(shown) else LEAST_NOISE


def _weights(of: _Data, error: np.ndarray, noise: float) -> np.ndarray:
    """Weights [n, F, 3]: squared colour, so that errors count in grey levels, times that of the robust kernel."""
    ratio = of.colours * error / np.float32(KERNEL * noise)
    return np.asarray(np.where(of.usable, np.square(of.colours / (1 + ratio * ratio)), np.float32(0)))


def _cost(of: _Data, error: np.ndarray, noise: float) -> float:
    """Robust cost of the errors, by the kernel of `_weights`."""
    squares = np.square(of.colours * error / np.float32(KERNEL * noise))
    return float((squares / (1 + squares))[of.usable].sum(dtype=float))


def _radiance_step(weight: np.ndarray, slope: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Change [n, 3] of the log radiances that fits the errors best."""
    scatter = (weight * slope * slope).sum(axis=1)
    return np.asarray((weight * slope * error).sum(axis=1) / np.where(scatter > 0, scatter, 1.0))


def _brightened(radiance: np.ndarray, step: np.ndarray) -> np.ndarray:
    return np.asarray(np.clip(radiance * np.exp(np.clip(step, -1, 1)), LEAST_RADIANCE, MOST_RADIANCE))


def _step(of: _Data, model: Model, state: _State, error: np.ndarray, noise: float, trust: float) -> _State:
    """One Gauss-Newton step of all parameters, the radiances eliminated."""
    F, light, slope = error.shape[1], state.light, _slopes(of, state)
    weight, extras = _weights(of, error, noise), _extras(of, model, state)
    solution = _solve(weight, slope, error, extras, model.gains, trust)
    tables, rest = solution[: model.gains * F].reshape(-1, F).T, solution[model.gains * F :]
    moved = replace(light, vignetting=light.vignetting + float(rest[0]))
    if model.gains:
        moved = replace(moved, log_gains=light.log_gains + tables)
    if model.fog:
        extinction = float(np.clip(light.extinction + rest[1] / of.unit, 0.0, MOST_EXTINCTION / of.unit))
        scattered = light.scattered + rest[2:] / of.unit
        scattered = np.clip(scattered, of.least_airlight(extinction) * extinction, MOST_AIRLIGHT * extinction)
        moved = replace(moved, extinction=extinction, scattered=scattered)
    # The radiances follow: what the other parameters, as they are now, leave over.
    left = _errors(of, _State(moved, state.radiance))
    return _State(moved, _brightened(state.radiance, _radiance_step(weight, slope, left)))


def _extras(of: _Data, model: Model, state: _State) -> list[np.ndarray]:
    """Derivatives [n, F, 3] of the log colours by vignetting, and by b and b A [3] over the median distance."""
    extras = [np.broadcast_to(of.off_axis, of.colours.shape)]
    if model.fog:
        clear, scattering, linear = _linear(of, state)
        b, r, scale = state.light.extinction, of.distance, of.unit * DISPLAY_GAMMA * linear
        # d scattering / d b = (r t - (1 - t) / b) / b, which is -r^2 / 2 where b is 0
        bent = (r * clear - scattering) / b if b * of.unit > 1e-3 else -r * r / 2
        by_b = -r * clear * state.radiance[:, None] + bent * state.light.scattered
        extras.append((by_b / scale).astype(np.float32))
        extras += [(scattering / scale * channel).astype(np.float32) for channel in np.eye(3)]
    return extras


def _solve(
    weight: np.ndarray, slope: np.ndarray, error: np.ndarray, extras: list[np.ndarray], gains: int, trust: float
) -> np.ndarray:
    """Steps of the gains, table by table, and of the extras, from the normal equations without the radiances."""
    F, K = error.shape[1], len(extras)
    weighted = weight * slope
    scatter = (weighted * slope).sum(axis=1)
    inverse = np.divide(1.0, scatter, out=np.zeros_like(scatter), where=scatter > np.finfo(scatter.dtype).tiny)

    def clear_of_radiance(values: np.ndarray) -> np.ndarray:
        return np.asarray(weight * (values - slope * ((weighted * values).sum(axis=1) * inverse)[:, None]))

    parts = [clear_of_radiance(values) for values in (*extras, error)]
    first, size = gains * F, gains * F + K
    normal, right = np.zeros((size, size)), np.zeros(size)
    for c in range(3 if gains else 0):
        at = slice((c % gains) * F, (c % gains + 1) * F)
        product = weighted[..., c].T @ (inverse[:, c, None] * weighted[..., c])
        normal[at, at] += np.diag(weight[..., c].sum(axis=0, dtype=float)) - product
        sums = np.stack([part[..., c].sum(axis=0, dtype=float) for part in parts], axis=1)
        normal[at, first:] += sums[:, :-1]
        right[at] += sums[:, -1]
    normal[first:, :first] = normal[:first, first:].T
    for j, extra in enumerate(extras):
        products = [float(np.vdot(extra, part)) for part in parts]
        normal[first + j, first:], right[first + j] = products[:-1], products[-1]
    for c in range(gains):  # the mean gain is that of the radiances
        at = slice(c * F, (c + 1) * F)
        normal[at, at] += np.trace(normal[at, at]) / F / F
    damping = np.where(np.arange(size) > first, trust * np.diagonal(normal), 0.0)
    damping += DAMPING * max(np.trace(normal) / size, 1e-12)
    return np.asarray(np.linalg.solve(normal + np.diag(damping), right))
