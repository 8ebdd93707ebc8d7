"""What a richer model buys over a simpler one: the error that it saves on samples that neither was fitted to."""

from typing import NamedTuple

import numpy as np

OUTLIER = 4.0
"""A sample that misses both models by more than this many standard deviations of the noise shows something else."""
SIGNIFICANT = 2.0
"""What is saved must exceed this many of its standard errors, or signed ranks of the groups this many of theirs."""


class Bought(NamedTuple):
    """What a model saves.

    Attributes:
        saved, sigma: mean squared error saved per sample, and its standard error over the groups of samples.
        before: mean squared error of the simpler model. samples: their number.
        rank_sigmas: how far beyond chance the groups that gain outrank those that lose (Wilcoxon 1945), in standard
            deviations. Where few groups gain much, their mean is uncertain, but not that they gain.
    """

    saved: float
    sigma: float
    before: float
    samples: int
    rank_sigmas: float = 0.0

    @property
    def size(self) -> float:
        """Root of what is saved, in the unit of the errors; negative where the richer model is worse."""
        return _root(self.saved)

    @property
    def interval(self) -> tuple[float, float]:
        """`size` at SIGNIFICANT standard errors less and more."""
        return _root(self.saved - SIGNIFICANT * self.sigma), _root(self.saved + SIGNIFICANT * self.sigma)

    @property
    def share(self) -> float:
        """Share of the squared error that is saved."""
        return self.saved / self.before if self.before > 0 else 0.0

    def reaches(self, threshold: float, share: float) -> bool:
        """Whether `size` and `share` reach their thresholds, beyond chance."""
        return self.size >= threshold and self.share >= share and self.interval[0] > 0


NOTHING = Bought(0.0, 0.0, 0.0, 0)


def weigh(simple: np.ndarray, rich: np.ndarray, groups: np.ndarray, *, trimmed: bool = True) -> Bought:
    """What errors `rich` [n] save over `simple` [n], both of held-out samples, of one sign or not.

    Samples that both models miss are left out, if `trimmed`; which ones these are favours neither. The standard error
    is that of a mean over the groups [n] of samples, since the errors within a group are alike. Of a single group it is
    all that is saved.
    """
    smaller = np.minimum(np.abs(simple), np.abs(rich))
    if not smaller.size:
        return NOTHING
    kept = smaller <= OUTLIER * 1.4826 * np.median(smaller) if trimmed else np.ones(len(smaller), bool)
    squares = np.square(simple[kept], dtype=float)
    per_group = _sums(groups[kept], squares - np.square(rich[kept], dtype=float))
    count, n = int(kept.sum()), len(per_group)
    saved = float(per_group.sum()) / count
    sigma = float(per_group.std(ddof=1)) * n**0.5 / count if n > 1 else abs(saved)
    return Bought(saved, sigma, float(squares.mean()), count, signed_ranks(per_group))


def signed_ranks(values: np.ndarray) -> float:
    """Sum of the signed ranks of values [n] by size, over its standard deviation if either sign is as likely."""
    values = values[values != 0]
    rank = np.argsort(np.argsort(np.abs(values))) + 1.0
    return float((np.sign(values) * rank).sum() / np.sqrt(max(np.square(rank).sum(), 1.0)))


def _sums(groups: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Sum of the values of each group that has any."""
    _, index = np.unique(groups, return_inverse=True)
    return np.bincount(index.ravel(), values)


def _root(square: float) -> float:
    return float(np.sign(square) * np.sqrt(abs(square)))
