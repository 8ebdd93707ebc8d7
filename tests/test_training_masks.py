"""Training of the network at the borders of masks: it learns what the truth shows, and goes on where it was stopped."""

from pathlib import Path

import numpy as np
import pytest

from stages.segment.network import correct
from training.masks import fit as training
from training.masks.examples import OPEN, Example
from training.masks.fit import Settings, fit

MAPS, H, W = 7, 60, 100


def example(seed: int) -> Example:
    """A disc whose upper half the evidence misses; another map shows all of it, and a strip of it is open."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:H, :W]
    middle = rng.integers(25, 35), rng.integers(35, 65)
    disc = np.hypot(v - middle[0], u - middle[1]) < 18
    maps = rng.normal(0, 0.3, (MAPS, H, W))
    maps[0] = np.where(disc & (v > middle[0]), 1, -1)
    maps[2] = np.where(disc, 1, -1) + rng.normal(0, 0.3, (H, W))
    truth = np.where(np.abs(u - middle[1]) < 2, OPEN, disc).astype(np.uint8)
    return Example(maps.astype(np.float16), truth, np.ones((H, W), bool))


EXAMPLES = [[example(10 * clip + k) for k in range(3)] for clip in range(3)]


def test_it_learns_which_evidence_to_believe(tmp_path: Path) -> None:
    """On a disc that it has not seen: half of it was missed, next to nothing is."""
    network = fit(EXAMPLES, Settings(seed=0, steps=40), tmp_path / "checkpoint.pt")
    maps, truth, asked = example(99)
    found = correct(network, maps.astype(np.float32), asked, (maps[0].astype(np.float32) + 1) / 2) > 0.5
    known = truth != OPEN
    assert ((maps[0] > 0) != (truth == 1))[known].mean() > 0.06
    assert (found != (truth == 1))[known].mean() < 0.02


def test_a_training_that_was_stopped_ends_as_one_that_was_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "KEPT_EVERY", 2)
    whole = fit(EXAMPLES, Settings(0, 6), tmp_path / "whole.pt")
    batches, batch = [], training._batch

    def stopped(*of: object) -> object:
        batches.append(of)
        if len(batches) == 5:
            raise KeyboardInterrupt
        return batch(*of)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(training, "_batch", stopped)
        with pytest.raises(KeyboardInterrupt):
            fit(EXAMPLES, Settings(0, 6), tmp_path / "stopped.pt")
    for one, other in zip(whole, fit(EXAMPLES, Settings(0, 6), tmp_path / "stopped.pt"), strict=True):
        np.testing.assert_array_equal(one, other)
    assert any(
        (one != other).any() for one, other in zip(whole, fit(EXAMPLES, Settings(1, 6), tmp_path / "x.pt"), strict=True)
    )


def test_what_is_open_teaches_nothing() -> None:
    rng = np.random.default_rng(0)
    for _ in range(5):
        _, truth, weight = training._crop(EXAMPLES[0][0], rng)
        assert set(np.unique(truth)) == {0, 1}
        assert ((weight == 0) | (weight == 1)).all()
        assert 0.01 < (weight[:H] == 0).mean() < 0.2
