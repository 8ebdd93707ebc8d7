"""The fit of the models of light (light_model.py) to the colours of static points; the radiances are eliminated."""

from dataclasses import replace

import numpy as np

from stages.scene.light_model import Light, Model, Points, State, brightened, derivatives, errors_of, slopes_of
from stages.scene.light_system import normal_step
from stages.scene.sightings import GROUP, Sightings

ITERATIONS, EVALUATIONS = 5, 3
FIRST_FOG_ITERATIONS, FOG_ITERATIONS, LEAST_PROGRESS = ((3, 3), (5, 1)), 20, 1e-3
"""With fog: of each first extinction, which is held, and how many of them go on; of the best one; share of the cost
below which it has arrived."""
RANKING = 400
"""Points that suffice for the choice of a first extinction."""
KERNEL = 3.0
"""Scale of the robust kernel in standard deviations of the noise, itself no less than LEAST_NOISE."""
LEAST_NOISE = 1e-3
TRUST, TRUST_FACTOR = 1e-3, 10.0
"""First damping of the unknowns of fog (Levenberg-Marquardt), and the factor by which it changes."""
MOST_LOG_GAIN = float(np.log(255))
"""Of gains, and of vignetting in the corners: eight bits show no more. A handful of points that have nothing in common
let both grow against each other, until the colours that they would have to explain overflow."""
MOST_AIRLIGHT = 1.5
MOST_EXTINCTION = 5.0
"""Per median distance: less than a hundredth of the light is left."""
FIRST_EXTINCTIONS = (0.06, 0.12, 0.25, 0.5, 1.0, 2.0)
"""Where the search looks first, per median distance, with the colour of the most distant points as airlight."""
FOLLOWING = 2
"""Further steps of the radiances behind fog, for each of the other parameters."""
HELD = 1e6
"""Damping of an extinction that is held."""


def fit(seen: Sightings, model: Model, rows: np.ndarray, start: Light) -> Light:
    """The parameters of a model that explain the points `rows` [n] bool best (Gauss-Newton, Geman-McClure weights).

    Args:
        start: where to begin: parameters of this model or of one that it contains.
    """
    of = Points(seen, rows)
    if not of.usable.any():
        return start
    if not model.fog:
        return _improved(of, model, State(start, of.mean_radiance(start)), ITERATIONS).light
    if start.extinction == 0:
        step = max(int(rows.sum()) // RANKING, 1)
        start = _first_fog(Points(seen, rows & (rows.cumsum() // GROUP % step == 0)), model, start)
    return _improved(of, model, State(start, of.mean_radiance(start)), FOG_ITERATIONS).light


def _first_fog(of: Points, model: Model, start: Light) -> Light:
    """The best fog of FIRST_EXTINCTIONS, everything else fitted to each; from the next of them the search gets stuck.

    A vignetting that was fitted without fog has taken its part, and keeps it: all begin without. Thin bright fog fits
    best at first, and worse than any later on: several go on before one is chosen.
    """
    lights = [
        replace(start, vignetting=0.0, extinction=float(b), scattered=b * of.far_radiance)
        for b in np.array(FIRST_EXTINCTIONS) / of.unit
    ]
    states = [State(light, of.mean_radiance(light)) for light in lights]
    for iterations, kept in FIRST_FOG_ITERATIONS:
        states = [_improved(of, model, state, iterations, HELD) for state in states]
        errors = [errors_of(of, state) for state in states]
        noise = min(_noise(of, error) for error in errors)
        costs = [_cost(of, error, noise) for error in errors]
        states = [states[n] for n in np.argsort(costs, kind="stable")[:kept]]
    return states[0].light


def _improved(of: Points, model: Model, state: State, iterations: int, held: float = 0.0) -> State:
    """The parameters after so many steps; with fog, in which they are not linear, only steps that help are made.

    Args:
        held: further damping of the extinction.
    """
    trust = TRUST
    for _ in range(iterations):
        error = errors_of(of, state)
        noise = _noise(of, error)
        moved = _step(of, model, state, error, noise, (trust, held))
        if model.fog:
            before, after = _cost(of, error, noise), _cost(of, errors_of(of, moved), noise)
            if after > before:
                trust *= TRUST_FACTOR
                continue
            if trust <= TRUST and before - after < LEAST_PROGRESS * before:
                return moved
        state, trust = moved, trust / TRUST_FACTOR
    return state


def residuals(seen: Sightings, light: Light, rows: np.ndarray) -> np.ndarray:
    """Errors [m, F, 3] of the colours of the points `rows`, 0..1, each with its own best radiance; 0 where unusable."""
    of = Points(seen, rows)
    state = State(light, of.mean_radiance(light))
    for _ in range(EVALUATIONS):
        error = errors_of(of, state)
        slope = slopes_of(of, state)
        weight = _weights(of, error, _noise(of, error))
        state = State(light, brightened(state.radiance, _radiance_step(weight, slope, error)))
    return of.spread(np.asarray(np.where(of.usable, of.colours * -np.expm1(-errors_of(of, state)), 0.0)))


def _noise(of: Points, error: np.ndarray) -> float:
    """Standard deviation of the errors of the colours, robustly."""
    shown = np.abs(of.colours * error)[of.usable]
    return max(1.4826 * float(np.median(shown)), LEAST_NOISE) if len(shown) else LEAST_NOISE


def _weights(of: Points, error: np.ndarray, noise: float) -> np.ndarray:
    """Weights [n, 3, S]: squared colour, so that errors count in grey levels, times that of the robust kernel."""
    ratio = of.colours * error / np.float32(KERNEL * noise)
    return np.asarray(np.where(of.usable, np.square(of.colours / (1 + ratio * ratio)), np.float32(0)))


def _cost(of: Points, error: np.ndarray, noise: float) -> float:
    """Robust cost of the errors, by the kernel of `_weights`."""
    squares = np.square(of.colours * error / np.float32(KERNEL * noise))
    return float((squares / (1 + squares))[of.usable].sum(dtype=float))


def _radiance_step(weight: np.ndarray, slope: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Change [n, 3] of the log radiances that fits the errors best."""
    scatter = (weight * slope * slope).sum(axis=2)
    return np.asarray((weight * slope * error).sum(axis=2) / np.where(scatter > 0, scatter, 1.0))


def _bounded(logarithm: np.ndarray) -> np.ndarray:
    """Gains or vignetting, as logarithms of any shape, within MOST_LOG_GAIN."""
    return np.asarray(np.clip(logarithm, -MOST_LOG_GAIN, MOST_LOG_GAIN))


def _step(of: Points, model: Model, state: State, error: np.ndarray, noise: float, trust: tuple[float, float]) -> State:
    """One Gauss-Newton step of all parameters, the radiances eliminated; `trust` damps fog, and its extinction more."""
    F, light, slope = of.F, state.light, slopes_of(of, state)
    weight, extras = _weights(of, error, noise), derivatives(of, model, state)
    solution = normal_step(of, (weight, slope, error), extras, model.gains, trust)
    tables, rest = solution[: model.gains * F].reshape(-1, F).T, solution[model.gains * F :]
    moved = replace(light, vignetting=float(_bounded(light.vignetting + rest[0])))
    if model.gains:
        moved = replace(moved, log_gains=_bounded(light.log_gains + tables))
    if model.fog:
        extinction = float(np.clip(light.extinction + rest[1] / of.unit, 0.0, MOST_EXTINCTION / of.unit))
        scattered = light.scattered + rest[2:] / of.unit
        scattered = np.clip(scattered, of.least_airlight(extinction) * extinction, MOST_AIRLIGHT * extinction)
        moved = replace(moved, extinction=extinction, scattered=scattered)
    # The radiances follow: what the other parameters, as they are now, leave over. Behind another fog that takes more
    # than one step, and until they have followed, a step along the valley of extinction and airlight seems to lead up.
    left = errors_of(of, State(moved, state.radiance))
    state = State(moved, brightened(state.radiance, _radiance_step(weight, slope, left)))
    for _ in range(FOLLOWING if model.fog else 0):
        left = errors_of(of, state)
        step = _radiance_step(_weights(of, left, noise), slopes_of(of, state), left)
        state = State(moved, brightened(state.radiance, step))
    return state
