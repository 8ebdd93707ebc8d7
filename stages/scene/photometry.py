"""Evidence from colours: which model of light predicts static points that it was not fitted to, and do views matter?"""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from stages.scene import light
from stages.scene.light_model import Light, Model, cleared, no_light
from stages.scene.sightings import GROUP, Sightings
from stages.scene.weigh import NOTHING, Bought, weigh

GREY_LEVELS = 255.0
LEAST_GREY, LEAST_SHARE = 0.7, 0.15
"""Grey levels of held-out error, and share of its square, that gains must save: 0.07 dB at 33 dB."""
LEAST_FOG_GREY, LEAST_FOG_SHARE = 0.29, 0.3
"""Of fog, which has four parameters and costs next to nothing: as much as 8 bits round off. Its share is larger, since
it imitates whatever differs between the near ground and the rest, as bands of flicker do."""
LIGHT_GROUPS = 300
"""Groups of points that light is fitted to and judged on: gains and fog are few numbers. Views need all groups, since
few of them shine."""
MIN_DISTANCE_CHANGE = 0.02
"""Median relative range: with less, fog of any density changes hardly any colour, and none is fitted."""
RIDGE = 1e-2
SHRINKAGE = 5.0
"""Harmonics are shrunk (James and Stein 1961): hardly where they explain far more than noise, to nothing where they
explain less than so many times what noise would if errors in neighbouring frames were independent."""


class LightEvidence(NamedTuple):
    """What each part of the light buys beside the other parts that are modelled, in grey levels.

    Attributes:
        exposure: a gain per frame. white_balance: a gain per channel beside it. atmosphere: fog.
        model: the parts that buy enough. fitted: its parameters, from all cells.
        distance_change: median over the points of the range of their distances, over their distance.
    """

    exposure: Bought
    white_balance: Bought
    atmosphere: Bought
    model: Model
    fitted: Light
    distance_change: float


def light_evidence(seen: Sightings, foggy: bool = False) -> LightEvidence:
    """Gains, white balance and fog, each judged on cells of space that it was not fitted to.

    Parts are added while they buy enough, the one that saves most first: a part that only imitates another one then
    buys nothing.

    Args:
        foggy: `fitted` has fog whether that buys enough or not, where fog is observable.
    """
    seen = _some_groups(seen)

    @cache
    def errors(model: Model) -> np.ndarray:
        return _held_out_errors(seen, model)

    @cache
    def bought(simple: Model, rich: Model) -> Bought:
        if rich.fog and not observable:
            return NOTHING
        usable = seen.usable
        cells = np.broadcast_to(seen.cell[:, None, None], usable.shape)[usable]
        return weigh(errors(simple)[usable], errors(rich)[usable], cells)

    distance_change = _distance_change(seen)
    observable = distance_change >= MIN_DISTANCE_CHANGE
    chosen = _chosen(bought)
    return LightEvidence(
        bought(Model(0, chosen.fog), Model(1, chosen.fog)),
        bought(Model(1, chosen.fog), Model(3, chosen.fog)),
        bought(Model(chosen.gains, False), Model(chosen.gains, True)),
        chosen,
        _fit_all(seen, chosen._replace(fog=chosen.fog or (foggy and observable))),
        distance_change,
    )


def _some_groups(seen: Sightings) -> Sightings:
    """At most LIGHT_GROUPS of the groups of points, spread over all."""
    count = len(seen.cell) // GROUP
    chosen = np.unique(np.linspace(0, count - 1, min(count, LIGHT_GROUPS)).astype(int))
    rows = (GROUP * chosen[:, None] + np.arange(GROUP)).ravel()
    of_points = (name for name in seen._fields if name != "centres")
    return seen._replace(**{name: getattr(seen, name)[rows] for name in of_points})


def is_worth(bought: Bought, fog: bool) -> bool:
    """Whether a part of the light buys enough."""
    return bought.reaches(*((LEAST_FOG_GREY, LEAST_FOG_SHARE) if fog else (LEAST_GREY, LEAST_SHARE)))


def _chosen(bought: Callable[[Model, Model], Bought]) -> Model:
    """The model reached from a constant light by adding what buys most, while that is enough.

    Gains or fog is added as the best of their models says, but of gains one per frame first, if that buys enough.
    """
    model = Model(0, False)
    while True:
        richer = [Model(number, model.fog) for number in (1, 3) if number > model.gains]
        gains = [more for more in richer if is_worth(bought(model, more), fog=False)]
        fog = [] if model.fog else [Model(model.gains, True)]
        fog = [more for more in fog if is_worth(bought(model, more), fog=True)]
        if not gains and not fog:
            return model
        saved = [max((bought(model, more).saved for more in kind), default=0.0) for kind in (gains, fog)]
        model = gains[0] if saved[0] >= saved[1] else fog[0]


def _held_out_errors(seen: Sightings, model: Model) -> np.ndarray:
    """Errors [n, F, 3] in grey levels, of each half of the cells with the parameters of the other half."""
    errors = np.zeros(seen.colours.shape, np.float32)
    for half in (seen.odd, ~seen.odd):
        errors[half] = light.residuals(seen, _fit(seen, model, ~half), half)
    return GREY_LEVELS * errors


def _fit(seen: Sightings, model: Model, rows: np.ndarray) -> Light:
    """The parameters of a model from the points `rows`; fog begins at the gains without it."""
    start = no_light(seen.colours.shape[1])
    if model.fog:
        start = light.fit(seen, model._replace(fog=False), rows, start)
    return light.fit(seen, model, rows, start)


def _distance_change(seen: Sightings) -> float:
    """`LightEvidence.distance_change`; 0 of no points."""
    usable = seen.usable.any(axis=2)
    farthest = np.where(usable, seen.distance, 0.0).max(axis=1)
    nearest = np.where(usable, seen.distance, np.inf).min(axis=1)
    return float(np.median((farthest - nearest) / farthest)) if len(farthest) else 0.0


def _fit_all(seen: Sightings, model: Model) -> Light:
    return _fit(seen, model, np.ones(len(seen.cell), bool))


class ViewEvidence(NamedTuple):
    """What colours that change with the view buy, in grey levels: harmonics of degree 1 and 2 over none.

    Attributes:
        degrees: of 1 and 2. angle_deg: median range of the viewing directions.
    """

    degrees: tuple[Bought, Bought]
    angle_deg: float


def view_evidence(seen: Sightings, fitted: Light) -> ViewEvidence:
    """How well the change of a point's colour with the view predicts that of its neighbours, at other times.

    Gloss changes neighbours on a surface alike. A pose or depth that is slightly wrong also changes a colour smoothly
    over the frames, but each point's by its own surroundings.
    """
    colours, directions, usable = view_groups(seen, fitted)
    errors, judged = zip(*(_predicted(colours, directions, usable, degree) for degree in range(3)), strict=True)
    kept = np.logical_and.reduce(judged)
    if not kept.any():
        return ViewEvidence((NOTHING, NOTHING), 0.0)
    cell = np.broadcast_to(seen.cell.reshape(-1, GROUP, 1, 1), errors[0].shape)[kept]
    none, first, second = (GREY_LEVELS * error[kept] for error in errors)
    degrees = weigh(none, first, cell), weigh(none, second, cell)
    return ViewEvidence(degrees, _angle_deg(directions, usable))


def view_groups(seen: Sightings, fitted: Light) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cleared colours and viewing directions [g, GROUP, F, 3] of the points; where they are usable [g, GROUP, F]."""
    usable = seen.usable.all(axis=2).reshape(-1, GROUP, seen.usable.shape[1])
    rays = seen.points[:, None] - seen.centres
    directions = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return cleared(seen, fitted).reshape(*usable.shape, 3), directions.reshape(*usable.shape, 3), usable


def by_view(
    colours: np.ndarray, directions: np.ndarray, usable: np.ndarray, fitted: np.ndarray, degree: int
) -> np.ndarray:
    """How colours change with the view, [g, GROUP, F, 3]: harmonics that a group shares, of its sightings `fitted`."""
    basis = _basis(directions, usable, degree)
    return np.asarray(basis @ _coefficients(colours, basis, fitted)[:, None])


def _angle_deg(directions: np.ndarray, usable: np.ndarray) -> float:
    """Median over the first points of the groups of the largest angle to their first sighting."""
    seen, views = usable[:, 0], directions[:, 0]
    reference = views[np.arange(len(views)), seen.argmax(axis=1)]
    cosine = np.einsum("gfc,gc->gf", views, reference)
    angle = np.where(seen, np.arccos(np.clip(cosine, -1, 1)), 0.0).max(axis=1)
    return float(np.degrees(np.median(angle[seen.any(axis=1)])))


def _predicted(
    colours: np.ndarray, directions: np.ndarray, usable: np.ndarray, degree: int
) -> tuple[np.ndarray, np.ndarray]:
    """Errors [g, GROUP, F, 3] of colours, and which are judged: predicted from two neighbours in every other frame.

    Of a point itself, only the mean colour in these frames is used.
    """
    basis = _basis(directions, usable, degree)
    errors, judged = np.zeros(colours.shape, np.float32), np.zeros(colours.shape, bool)
    even = np.arange(usable.shape[2]) % 2 == 0
    for rows, others in (((0, 3), (1, 2)), ((1, 2), (0, 3))):
        for frames in (even, ~even):
            fitted = usable & frames
            change = basis @ _coefficients(colours[:, others], basis[:, others], fitted[:, others])[:, None]
            own, count = fitted[:, rows, :, None], np.maximum(fitted[:, rows].sum(axis=2), 1)[..., None, None]
            left = colours[:, rows] - change[:, rows]
            error = left - (left * own).sum(axis=2, keepdims=True) / count
            target = usable[:, rows] & ~frames & (fitted[:, rows].sum(axis=2, keepdims=True) >= 2)
            target &= fitted[:, others].all(axis=1).sum(axis=1)[:, None, None] >= 2
            for k, row in enumerate(rows):
                errors[:, row] = np.where(target[:, k, :, None], error[:, k], errors[:, row])
                judged[:, row] |= target[:, k, :, None]
    return errors, judged


def _basis(directions: np.ndarray, usable: np.ndarray, degree: int) -> np.ndarray:
    """Polynomials of degree 1 to `degree` of the viewing directions, centred and of unit spread: [g, GROUP, F, 0..9].

    On the unit sphere they and a constant span what spherical harmonics of that degree span.
    """
    count = np.maximum(usable.sum(axis=(1, 2)), 1)[:, None, None, None]
    shown = usable[..., None]
    mean = (directions * shown).sum(axis=(1, 2), keepdims=True) / count
    x = np.where(shown, directions - mean, 0.0)
    spread = np.sqrt(np.square(x).sum(axis=(1, 2, 3), keepdims=True) / count)
    x = x / np.where(spread > 0, spread, 1.0)
    columns = [x[..., :0]]
    if degree >= 1:
        columns.append(x)
    if degree >= 2:
        columns += [x * x, x * np.roll(x, 1, axis=-1)]
    return np.concatenate(columns, axis=-1)


def _coefficients(colours: np.ndarray, basis: np.ndarray, fitted: np.ndarray) -> np.ndarray:
    """Coefficients [g, K, 3] that the points [g, m] share, each with its own mean: ridge, then SHRINKAGE."""
    shown, count = fitted[..., None], np.maximum(fitted.sum(axis=2), 1)[..., None, None]
    x, y = (np.where(shown, part - (part * shown).sum(axis=2, keepdims=True) / count, 0.0) for part in (basis, colours))
    size, K = fitted.sum(axis=(1, 2)), basis.shape[-1]
    normal = np.einsum("gmfi,gmfj->gij", x, x) + (RIDGE * np.maximum(size, 1))[:, None, None] * np.eye(K)
    found = np.linalg.solve(normal, np.einsum("gmfi,gmfc->gic", x, y))
    change = x @ found[:, None]
    explained, left = (np.square(part).sum(axis=(1, 2, 3)) for part in (change, y - change))
    noise = K * left / np.maximum(size - fitted.any(axis=2).sum(axis=1) - K, 1)
    kept = np.maximum(1 - SHRINKAGE * noise / np.where(explained > 0, explained, np.inf), 0.0)
    return np.asarray(kept[:, None, None] * found)
