"""What a richer model of the camera buys on pixels held out of its fit.

More unknowns lower the residuals of any flow a little. So both models are fitted to the pixels of every other tile of
the image, and compared on the tiles between.
"""

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


@dataclass(frozen=True)
class Verdict:
    """The decision about a richer model and the numbers behind it.

    Attributes:
        decision: a word of the model's own, "not observable" or "not tested"; reason: why, in words.
        gain: share of the cost of held-out pixels that the model saves; gain_sigma: its standard error.
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
    """Cameras fitted to half of the tiles: their cost there, and the errors in px of every match [E, P] of the rest."""

    state: State
    cost: float
    held_out: np.ndarray


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
    return Fit(state, dba.robust_cost(fitted, dba.errors_px(fitted, state), SCHEDULE[-1].sigma_px), errors)


def gain(graph: FlowGraph, *pairs: tuple[Fit, Fit]) -> tuple[float, float]:
    """Share of the held-out cost that the richer model saves, and its standard error over the tiles.

    Args:
        pairs: the simpler and the richer model, fitted to `halves`; of a second pair, fitted with the halves swapped.
    """
    tiles, parts, total = _tiles(graph), [], 1e-12
    for (simple, rich), held_out in zip(pairs, (_odd(tiles), ~_odd(tiles)), strict=False):
        weights = graph.weights * held_out
        residual_px = float(np.median(rich.held_out[weights > MIN_WEIGHT])) if (weights > MIN_WEIGHT).any() else 1.0
        sigma_px = np.float32(np.clip(SHARP * residual_px, *SHARP_PX))
        before, after = (_costs(weights, fit.held_out / sigma_px) for fit in (simple, rich))
        parts.append(np.bincount(tiles, before - after)[np.unique(tiles[held_out])])
        total += float(before.sum())
    saved = np.concatenate(parts)
    return float(saved.sum() / total), float(np.sqrt(len(saved)) * saved.std(ddof=1) / total)


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
