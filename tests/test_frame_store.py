"""Maps of many frames that are not all in memory, against the same maps in one array."""

from pathlib import Path

import numpy as np
import pytest
import torch
from gaussian_scene import T as CLIP_FRAMES
from gaussian_scene import observations

from stages.gaussians.training_frames import TrainingFrames
from stages.gaussians.votes import inverse
from stages.shared.frame_store import Computed, PackedMasks, StoredFrames, median


def _noise(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).lognormal(size=shape).astype(np.float32)


@pytest.mark.parametrize("shape", [(5, 31, 17), (4, 32, 64), (1, 1, 1), (2, 1, 3)])
def test_the_median_is_that_of_all_values(shape: tuple[int, ...]) -> None:
    values = _noise(shape)
    assert median(values) == float(np.median(values))


def test_the_median_is_found_where_a_sample_says_little_about_it() -> None:
    values = np.zeros((3, 64, 64), np.float32)
    values[:, :, 1:] = _noise((3, 64, 63))  # the pixels that are sampled are all zero
    assert median(values) == float(np.median(values))


def test_stored_frames_are_read_as_written_and_leave_no_file(tmp_path: Path) -> None:
    values = _noise((6, 20, 30, 3))
    stored = StoredFrames(iter(values), tmp_path)
    first = stored[0]
    assert len(stored) == 6
    for f in (5, 0, 3):
        np.testing.assert_array_equal(stored[f], values[f])
    np.testing.assert_array_equal(first, values[0])  # what was given back is read again
    np.testing.assert_array_equal(np.array([stored[f] for f in range(6)]), values)
    assert not list(tmp_path.iterdir())


def test_stored_frames_hold_one_at_a_time(tmp_path: Path) -> None:
    def resident_mb() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6

    stored = StoredFrames((np.full((500, 1000), f, np.float32) for f in range(40)), tmp_path)
    before = resident_mb()
    assert sum(float(stored[f].sum()) for f in range(40)) == 500_000 * 780
    assert resident_mb() - before < 20  # of 80


def test_masks_are_packed_into_bits() -> None:
    masks = _noise((3, 13, 11)) > 1
    packed = PackedMasks(enumerate(masks))
    for f, mask in packed.items():
        np.testing.assert_array_equal(mask, masks[f])
        np.testing.assert_array_equal(inverse(packed)[f], ~masks[f])
    assert len(packed) == 3
    assert 7 not in packed


def test_frames_are_computed_once_as_far_as_there_is_room() -> None:
    asked: list[int] = []

    def compute(f: int) -> int:
        asked.append(f)
        return f * f

    squares = Computed(5, compute, most=2)
    for _ in range(2):
        assert [squares[f] for f in (3, 0, 4)] == [9, 0, 16]
    assert asked == [3, 0, 4, 4]
    with pytest.raises(IndexError):
        squares[5]


def test_the_mean_colour_of_a_long_clip_is_not_rounded_off() -> None:
    """A sum in single precision stops growing at 2^24 times the size of what is added: 0.12 in place of 0.3."""
    frames = Computed(140, lambda _: np.full((500, 600, 3), 0.3, np.float32))
    seen = TrainingFrames(frames, *[np.zeros((140, 1, 1))] * 3, *[np.zeros(140)] * 3)
    np.testing.assert_allclose(seen.mean_colour, 0.3, rtol=1e-6)


def test_figures_of_all_training_frames_are_those_of_the_array() -> None:
    seen = observations(list(range(CLIP_FRAMES)))
    assert isinstance(seen.images, np.ndarray)
    assert isinstance(seen.masks, np.ndarray)
    np.testing.assert_allclose(seen.mean_colour, seen.images.mean(axis=(0, 1, 2), dtype=float), rtol=1e-6)
    np.testing.assert_array_equal(seen.masked, seen.masks.sum(axis=(1, 2)))
    assert seen.median_depth == float(np.median(torch.as_tensor(seen.depths)))
    assert isinstance(seen, TrainingFrames)
    assert seen.size == seen.images.shape[1:3]
