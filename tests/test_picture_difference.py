"""What two pictures of one thing may differ by."""

import cv2
import numpy as np
import pytest

from stages.shared import picture_difference
from stages.shared.picture_difference import EVERY_PX, exposed


def picture(low: int = 40, high: int = 160) -> np.ndarray:
    """A picture [h, w, 3] uint8 with detail."""
    noise = cv2.GaussianBlur(np.random.default_rng(0).standard_normal((90, 120, 3)), (0, 0), 2)
    return np.asarray(cv2.normalize(noise, None, low, high, cv2.NORM_MINMAX).astype(np.uint8))


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0), (1.0, 20), (0.7, 5), (1.4, -10)])
def test_exposure_is_a_gain_and_an_offset_per_colour(gain: float, offset: float) -> None:
    other = np.clip(np.array([gain, 1.0, 1.1]) * picture() + (offset, 0, 3), 0, 255).astype(np.uint8)
    assert np.abs(exposed(picture(), other[::EVERY_PX, ::EVERY_PX]).astype(int) - other).max() <= 3


def test_a_mover_in_a_tenth_of_the_pictures_does_not_change_it() -> None:
    other = np.clip(1.2 * picture(), 0, 255).astype(np.uint8)
    moved = other.copy()
    moved[10:40, 10:46] = 250
    found = exposed(picture(), moved[::EVERY_PX, ::EVERY_PX]).astype(int)
    assert np.abs(found - other).mean() < 4


def test_a_picture_without_contrast_tells_no_gain() -> None:
    flat = np.full((30, 40, 3), 100, np.uint8)
    rng = np.random.default_rng(1)
    noisy = np.clip(flat + 10 + 2 * rng.standard_normal(flat.shape), 0, 255).astype(np.uint8)
    assert np.abs(exposed(flat, noisy[::EVERY_PX, ::EVERY_PX]).astype(int) - 110).max() <= 1
    assert np.abs(exposed(noisy, flat[::EVERY_PX, ::EVERY_PX]).astype(int) - (noisy.astype(int) - 10)).max() <= 1


@pytest.mark.parametrize("count", [1, 2, 9, 500])
@pytest.mark.parametrize("levels", [1, 3, 40, 256])
def test_medians_are_counted(count: int, levels: int) -> None:
    """Of even and odd numbers of levels, few and many of them alike."""
    rng = np.random.default_rng(count)
    for _ in range(20):
        here = rng.integers(0, levels, count).astype(np.uint8)
        there = np.clip(1.3 * here + rng.normal(0, 9, count), 0, 255).astype(np.uint8)
        bright, gain = here > np.median(here), 1.0
        if bright.any():
            apart = np.median(here[bright]) - np.median(here[~bright])
            if apart >= picture_difference.LEAST_CONTRAST:
                change = np.median(there[bright]) - np.median(there[~bright])
                gain = float(np.clip(change / apart, *picture_difference.GAINS))
        expected = gain, np.median(there) - gain * np.median(here)
        assert picture_difference._line(here, there) == expected
