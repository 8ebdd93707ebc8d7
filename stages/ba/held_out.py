"""What a richer model of the camera buys on pixels held out of its fit.

More unknowns lower the residuals of any flow a little. So both models are fitted to the pixels of every other tile of
the image, and compared on the tiles between.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stages.ba import dba, initialise
from stages.ba.graph import MIN_WEIGHT, FlowGraph
from stages.ba.state import FocalPrior, Level, State, Unknowns

TILES = (4, 6)
"""Rows and columns of the tiles of an image."""
SCHEDULE = (Level(1.0, 12, 1e-3), Level(0.5, 15, 1e-4))
SHARP, SHARP_PX = 2.0, (0.05, 0.5)
"""Robust scale of the comparison in units of the median residual, and its limits in px."""
TRIMMED = 0.25
"""Share of the tiles, those that save most and those that save least, that a usual gain leaves out."""
MIN_TILES = 4
"""A usual gain needs so many tiles with matches."""


@dataclass(frozen=True)
class Verdict:
    """The decision about a richer model and the numbers behind it.

    Attributes:
        decision: a word of the model's own, "not observable" or "not tested"; reason: why, in words.
        gain: share of the cost of held-out pixels that the model saves, for a zoom and a rolling shutter on a usual
            tile; gain_sigma: its standard error.
        threshold: the gain from which on the model is taken, if that is significant.
        seconds: CPU time of the decision.
    """

    decision: str
    reason: str
    gain: float | None = None
    gain_sigma: float | None = None
    threshold: float | None = None
    seconds: float = 0.0


@dataclass(frozen=True)
class Fit:
    """Cameras fitted to half of the tiles: their cost there, and the errors in px of all matches [E, P]."""

    state: State
    cost: float
    errors: np.ndarray


def halves(graph: FlowGraph) -> tuple[FlowGraph, FlowGraph]:
    """The graph with the tiles to fit, and with those held out."""
    odd = _odd(_tiles(graph))
    fitted, held_out = (replace(graph, weights=graph.weights * half) for half in (~odd, odd))
    return fitted, held_out


def fit(parts: tuple[FlowGraph, FlowGraph], state: State, unknowns: Unknowns, prior: FocalPrior, name: str) -> Fit:
    """Cameras fitted to one half; the depth of a held-out pixel is its own best one, as it is for any camera."""
    fitted, held_out = parts
    state, _ = dba.solve(fitted, state, SCHEDULE, unknowns, prior, name)
    if unknowns.translation:
        state = initialise.search_depth(held_out, state, SCHEDULE[-1].sigma_px)
    errors = dba.errors_px(held_out, state)
    return Fit(state, dba.robust_cost(fitted, errors, SCHEDULE[-1].sigma_px), errors)


def gain(graph: FlowGraph, *pairs: tuple[Fit, Fit]) -> tuple[float, float]:
    """Share of the held-out cost that the richer model saves, and its standard error over the tiles.

    Args:
        pairs: the simpler and the richer model, fitted to `halves`; of a second pair, fitted with the halves swapped.
    """
    before, after = _of_tiles(graph, pairs)
    saved, total = before - after, float(before.sum()) + 1e-12
    return float(saved.sum() / total), float(np.sqrt(len(saved)) * saved.std(ddof=1) / total)


def usual_gain(graph: FlowGraph, *pairs: tuple[Fit, Fit], fitted: bool = False) -> tuple[float, float]:
    """Share of its cost that the richer model saves on a usual tile, and its standard error over the tiles.

    It is the mean of the middle half of the tiles. What moves along epipolar lines fits a static scene before some
    wrong cameras, but not before the right ones: the few tiles that it fills then cost more than all others save.
    From a handful of tiles nothing is told: no gain, and a standard error of 1.

    Args:
        pairs: as in `gain`; fitted: on the tiles fitted, to choose among models, not on those held out.
    """
    before, after = _of_tiles(graph, pairs, fitted)
    seen = before > 0
    if seen.sum() < MIN_TILES:
        return 0.0, 1.0
    return trimmed_mean(1 - after[seen] / before[seen])


def trimmed_mean(values: np.ndarray) -> tuple[float, float]:
    """Mean of the middle of n values, without TRIMMED of them at either end, and its standard error (Yuen 1974).

    That of scipy.stats, whose import takes as long as all else that this stage imports.
    """
    n, cut = len(values), int(TRIMMED * len(values))
    middle = np.sort(values)[cut : n - cut]
    winsorised = np.clip(values, middle[0], middle[-1])
    return float(middle.mean()), float(winsorised.std(ddof=1) / ((1 - 2 * TRIMMED) * np.sqrt(n)))


def _of_tiles(
    graph: FlowGraph, pairs: Sequence[tuple[Fit, Fit]], fitted: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Robust costs [n] of the simpler and of the richer model on all tiles held out, or on all fitted."""
    tiles, costs = _tiles(graph), []
    for (simple, rich), held_out in zip(pairs, (_odd(tiles), ~_odd(tiles)), strict=False):
        of = ~held_out if fitted else held_out
        weights = graph.weights * of
        residual_px = float(np.median(rich.errors[weights > MIN_WEIGHT])) if (weights > MIN_WEIGHT).any() else 1.0
        sigma_px = np.float32(np.clip(SHARP * residual_px, *SHARP_PX))
        both = [_costs(weights, fit.errors / sigma_px) for fit in (simple, rich)]
        costs.append([np.bincount(tiles, cost)[np.unique(tiles[of])] for cost in both])
    before, after = np.concatenate(costs, axis=1)
    return before, after


def _costs(weights: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """Robust cost [P] of every pixel, summed over its matches [E, P] in all frames; errors in units of the scale."""
    squared = ratio**2
    return np.asarray((weights * squared / (1 + squared)).sum(axis=0, dtype=float))


def _tiles(graph: FlowGraph) -> np.ndarray:
    """Number of the tile of every pixel [P], row by row."""
    rows, columns = (np.arange(n) * tiles // n for n, tiles in zip((graph.rows, graph.columns), TILES, strict=True))
    return (rows[:, None] * TILES[1] + columns).ravel()


def _odd(tiles: np.ndarray) -> np.ndarray:
    """Which tiles are held out: every other one, as on a chessboard."""
    return np.asarray((tiles // TILES[1] + tiles % TILES[1]) % 2 == 1)
