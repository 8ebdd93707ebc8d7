"""Reading the folder of masks that the segment stage writes."""

from pathlib import Path

import numpy as np
import pytest

from stages.shared.errors import InputError
from stages.shared.images import numbered_frames, write_image
from stages.shared.masks import instances_path, mask_path, read_instances, read_mask, read_masks, read_masks_on_grid
from stages.shared.sequences import Sequence

H, W = 24, 36
NUMBERS = [7, 9008, 10008]


@pytest.fixture
def masks(tmp_path: Path) -> np.ndarray:
    """Random masks [3, H, W], written to the folder of the test."""
    masks = np.random.default_rng(0).random((len(NUMBERS), H, W)) < 0.5
    for number, mask in zip(NUMBERS, masks, strict=True):
        write_image(mask_path(tmp_path, number), mask)
    return masks


@pytest.fixture
def frames(tmp_path: Path) -> Sequence:
    return Sequence("clip", [tmp_path / f"{number}.jpg" for number in NUMBERS], NUMBERS, W, H)


def test_masks_are_read_by_the_number_of_their_frame(tmp_path: Path, masks: np.ndarray, frames: Sequence) -> None:
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["frame_0007.png", "frame_10008.png", "frame_9008.png"]
    assert list(numbered_frames(tmp_path)) == NUMBERS
    found = read_masks(tmp_path, frames)
    assert list(found) == NUMBERS
    np.testing.assert_array_equal(np.stack(list(found.values())), masks)


def test_masks_without_instances_are_one(tmp_path: Path, masks: np.ndarray, frames: Sequence) -> None:
    np.testing.assert_array_equal(read_instances(tmp_path, frames, 1), masks[1])
    numbers = np.random.default_rng(1).integers(0, 1000, (H, W)).astype(np.uint16)
    write_image(instances_path(tmp_path, NUMBERS[1]), numbers)
    np.testing.assert_array_equal(read_instances(tmp_path, frames, 1), numbers)
    with pytest.raises(InputError, match="instances"):
        read_instances(tmp_path, frames, 0)


@pytest.mark.parametrize("factor", [3, 4])
def test_a_pixel_of_the_grid_is_dynamic_if_most_of_it_is(
    tmp_path: Path, masks: np.ndarray, frames: Sequence, factor: int
) -> None:
    counts = masks.reshape(3, H // factor, factor, W // factor, factor).sum(axis=(2, 4))
    found = read_masks_on_grid(tmp_path, frames, [2, 0], (W // factor, H // factor))
    np.testing.assert_array_equal(found, (2 * counts > factor**2)[[2, 0]])


def test_a_mask_that_does_not_fit_its_frame_is_named_with_the_next_step(
    tmp_path: Path, masks: np.ndarray, frames: Sequence
) -> None:
    write_image(mask_path(tmp_path, 9008), masks[1][:, :-1])
    mask_path(tmp_path, 7).unlink()
    with pytest.raises(InputError, match=r"frame_9008\.png: expected 36 x 24, found 35 x 24; run the segment stage"):
        read_mask(tmp_path, frames, 1)
    with pytest.raises(InputError, match=r"frame_0007\.png: expected a mask, found nothing there; run the segment"):
        read_masks(tmp_path, frames)
