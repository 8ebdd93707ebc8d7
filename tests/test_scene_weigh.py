"""Whether groups of samples gain beyond chance: by the mean of what they save, and by its signed ranks."""

import numpy as np
import pytest
from scipy.stats import wilcoxon

from stages.scene.weigh import SIGNIFICANT, signed_ranks, weigh


def test_signed_ranks_are_those_of_wilcoxon() -> None:
    values = np.random.default_rng(0).normal(0.3, 1.0, 40)
    truth = wilcoxon(values, method="asymptotic", alternative="greater")
    assert signed_ranks(values) == pytest.approx(truth.zstatistic)
    assert signed_ranks(np.append(values, np.zeros(9))) == signed_ranks(values)
    assert signed_ranks(np.zeros(3)) == 0


@pytest.mark.parametrize(("gaining", "beyond"), [(1.0, True), (0.5, False)])
def test_what_one_group_gains_most_of_is_beyond_chance_if_the_others_gain_too(gaining: float, beyond: bool) -> None:
    """One group of 20 saves forty times as much as the others: their mean is uncertain all the same."""
    groups = np.repeat(np.arange(20), 50)
    saved = np.where(groups == 0, 40.0, np.where(groups <= 20 * gaining, 1.0, -1.0))
    bought = weigh(np.sqrt(50.0 + saved), np.full(len(saved), 50.0**0.5), groups)
    assert bought.interval[0] < 0 < bought.size
    assert (bought.rank_sigmas > SIGNIFICANT) == beyond
