"""Examples that a solved sequence gives: of which rounds and frames, what is open in them, and that they are kept."""

from pathlib import Path

import numpy as np
import pytest
from passing_square import H, T, W, square
from test_confirmed_movers import masks_of

from training.masks import examples
from training.masks.examples import EVERY, OPEN, of_sequence


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The results of a clip in which a square moves, after one round, in frames of twice the size of the flow.

    The truth has it at rest in its upper half.
    """
    masks_of(tmp_path / "made", np.stack([square(k) for k in range(T)]), weight=1.0)
    folder = tmp_path / "clip"
    for name, to in (
        *(("sequence.json", "lens"), ("pairs.arrow", "lens"), ("prior.arrow", "motion")),
        *(("poses.parquet", "round1/ba"), ("depth.arrow", "round1/ba")),
    ):
        (folder / to).mkdir(parents=True, exist_ok=True)
        (tmp_path / "made" / name).rename(folder / to / name)
    whole = {k + 1: np.kron(square(k), np.ones((2, 2), bool)) for k in range(T)}
    lower = {number: of & (np.arange(2 * H) >= H)[:, None] for number, of in whole.items()}
    monkeypatch.setattr(examples, "true_masks", lambda _: (lower, "drawn"))
    monkeypatch.setattr(examples, "true_movers", lambda _: whole)
    return folder


def test_one_frame_in_some_teaches_and_what_rests_is_open(results: Path, tmp_path: Path) -> None:
    found = of_sequence(results, tmp_path)
    assert len(found) == len(range(0, T, EVERY))
    for k, (maps, truth, asked) in zip(range(0, T, EVERY), found, strict=True):
        mover, low = np.kron(square(k), np.ones((2, 2), bool)), (np.arange(2 * H) >= H)[:, None]
        np.testing.assert_array_equal(truth, np.where(mover, np.where(low, 1, OPEN), 0))
        assert maps.shape == (17, 2 * H, 2 * W)
        assert np.isfinite(maps).all()
        assert np.abs(maps).max() < 10
        assert maps[0][mover].mean() > 0.5 > -0.5 > maps[0][~mover].mean()
        assert asked[mover].any()


def test_they_are_kept_and_read_again(results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = of_sequence(results, tmp_path)
    monkeypatch.setattr(examples, "_found", lambda _: pytest.fail("made again"))
    for one, other in zip(before, of_sequence(results, tmp_path), strict=True):
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_sequence_that_is_not_solved_yet_teaches_nothing_until_it_is(results: Path, tmp_path: Path) -> None:
    poses, elsewhere = results / "round1/ba/poses.parquet", tmp_path / "poses.parquet"
    poses.rename(elsewhere)
    assert of_sequence(results, tmp_path) == []
    elsewhere.rename(poses)
    assert of_sequence(results, tmp_path)


def test_frames_that_are_too_large_or_without_truth_teach_nothing(
    results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(examples, "REFERENCE_PX", 2 * W - 1)
        assert of_sequence(results, tmp_path) == []
    monkeypatch.setattr(examples, "true_masks", lambda _: ({}, "none"))
    assert of_sequence(results, tmp_path) == []
