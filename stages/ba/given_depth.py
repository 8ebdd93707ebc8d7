"""Depth that the user hands in, in place of the estimate, after a comparison with what the adjustment has measured."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from stages.ba.depth import DepthMaps
from stages.ba.from_truth import MIN_INVERSE_DEPTH, RELATIVE_STD, resample
from stages.given.depth import open_depths
from stages.shared.errors import InputError
from stages.shared.log import logger
from stages.shared.sequences import Sequence

MEASURED = 0.3
"""Largest relative standard deviation of an estimated inverse depth that is compared."""
FEWEST, MOST = 100, 50_000
"""Pixels to compare: with fewer there is no comparison, and more would change nothing."""
REVERSED, AGREES = -0.3, 0.3
"""Rank correlations with the estimated depth: below the first, what is given grows towards the camera; above the second
it agrees. True depth has 0.4 to 1 where the cameras are right (18 scenes), and 0.2 where a zoom was missed."""
TIGHT, WIDE = 0.1, 0.5
"""Spreads of the ratio of given to estimated depth: below the first, ranks do not matter (a wall that faces the camera
has one depth); above the second, the depths are of something else. True depth has 0.001 to 0.33."""
LEVEL = 0.01
"""Ranks say nothing of depths that spread less than this."""
SCALE_TOLERANCE = 0.25
"""Largest difference of the logarithms of the scale of given depth and of that of fixed poses."""


class Agreement(NamedTuple):
    """How given depth compares with measured depth.

    Attributes:
        scale: given over measured depth, the median. spread: standard deviation of the logarithm of the ratio, robust.
        rank: their rank correlation. frames: spread of the medians of single frames. pixels: compared.
    """

    scale: float
    spread: float
    rank: float
    frames: float
    pixels: int


def given_depth_maps(
    frames: Sequence, folder: Path, estimated: DepthMaps, stride_px: float, gauge: float | None
) -> tuple[DepthMaps, str]:
    """The given inverse depth on the grid of the estimated maps and in their scale, and in words what was done.

    Pixels without given depth keep the estimate.

    Args:
        stride_px: pixels of the full frame per pixel of the grid.
        gauge: length in the gauge of the estimate over that of poses that are held fixed, whose scale the depth must
            have; None: the scale is free, and found.

    Raises:
        InputError: if the maps cannot be read, or disagree with what the adjustment has measured.
    """
    handed, shape = open_depths(folder, frames), estimated.inverse_depth.shape[1:]
    given = np.stack([resample(handed.inverse(k), shape, stride_px) for k in range(len(frames.numbers))])
    known = ~np.isnan(given)
    found = agreement(given, estimated)
    if found is None:
        near = known & (given > 0)
        found = Agreement(float(np.median(estimated.inverse_depth[near] / given[near])), 0, 1, 0, 0)
        about = "not compared: the adjustment has measured too few of them"
    else:
        refuse_disagreement(found, folder, gauge)
        about = f"scale {found.scale:.3g}, spread {100 * found.spread:.1f} %, rank correlation {found.rank:.2f}"
        about += f", spread over frames {100 * found.frames:.1f} %"
    told = f"{known.mean():.0%} of the pixels, {about}"
    logger.info("%s: depth of %s: %s", frames.name, folder, told)
    if found.spread > TIGHT:
        logger.warning(
            "%s: the given depth and what the adjustment measured differ by %.0f %%", frames.name, 100 * found.spread
        )
    scaled = np.maximum(given * (1 / gauge if gauge else found.scale), MIN_INVERSE_DEPTH)
    variance = (max(found.spread, RELATIVE_STD) * scaled) ** 2
    taken = np.where(known, scaled, estimated.inverse_depth), np.where(known, variance, estimated.variance)
    return DepthMaps(taken[0], taken[1], estimated.filled & ~known), told


def agreement(given: np.ndarray, estimated: DepthMaps) -> Agreement | None:
    """The comparison of given inverse depth [T, h, w] (NaN: unknown, 0: far) with estimates; None for few pixels."""
    inverse = estimated.inverse_depth
    used = (given > 0) & ~estimated.filled & (estimated.variance < (MEASURED * inverse) ** 2)
    if used.sum() < FEWEST:
        return None
    ratios = [np.log(inverse[k][used[k]] / given[k][used[k]]) for k in range(len(given))]
    medians = np.array([np.median(ratio) for ratio in ratios if len(ratio) >= FEWEST])
    every = np.concatenate(ratios)
    step = -(-used.sum() // MOST)
    rank = _rank_correlation(given[used][::step], inverse[used][::step])
    frames = _spread(medians) if len(medians) else 0.0
    return Agreement(float(np.exp(np.median(every))), _spread(every), rank, frames, len(every))


def refuse_disagreement(found: Agreement, folder: Path, gauge: float | None) -> None:
    """Refuse given depth that is disparity, is of something else, or has another scale than fixed poses.

    Raises:
        InputError: says which.
    """
    if found.rank < REVERSED and found.spread > LEVEL:
        told = f"numbers that grow towards the camera (rank correlation {found.rank:.2f} with the measured depth)"
        raise InputError(
            folder, "z-depth, larger where farther", told, "this is disparity: write depth = 1 / disparity"
        )
    if found.spread > WIDE or (found.rank < AGREES and found.spread > TIGHT):
        told = f"a spread of {found.spread:.0%} of their ratio and a rank correlation of {found.rank:.2f}"
        advice = "check that the maps are those of these frames, and whether the poses are right without them"
        raise InputError(folder, "depth that agrees with what the adjustment has measured", told, advice)
    if gauge is not None and abs(np.log(found.scale * gauge)) > SCALE_TOLERANCE:
        told = f"depth {found.scale * gauge:.3g} times as large"
        advice = f"divide it by {found.scale * gauge:.4g}, or do not fix the poses"
        raise InputError(folder, "depth in the scale of the fixed poses", told, advice)


def _spread(values: np.ndarray) -> float:
    """Standard deviation of values [n] as their median absolute deviation suggests."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def _rank_correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Spearman's correlation of values [n] of inverse depth; 0 if one of them is constant."""
    of_a, of_b = (np.unique(values, return_inverse=True)[1].astype(float) for values in (a, b))
    return float(np.corrcoef(of_a, of_b)[0, 1]) if min(of_a.max(), of_b.max()) > 0 else 0.0
