"""What two pictures of one thing may differ by."""

import cv2
import numpy as np
import pytest

from stages.shared.picture_difference import exposed


def picture(low: int = 40, high: int = 160) -> np.ndarray:
    """A picture [h, w, 3] uint8 with detail."""
    noise = cv2.GaussianBlur(np.random.default_rng(0).standard_normal((90, 120, 3)), (0, 0), 2)
    return np.asarray(cv2.normalize(noise, None, low, high, cv2.NORM_MINMAX).astype(np.uint8))


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0), (1.0, 20), (0.7, 5), (1.4, -10)])
def test_exposure_is_a_gain_and_an_offset_per_colour(gain: float, offset: float) -> None:
    other = np.clip(np.array([gain, 1.0, 1.1]) * picture() + (offset, 0, 3), 0, 255).astype(np.uint8)
    assert np.abs(exposed(picture(), other).astype(int) - other).max() <= 3


def test_a_mover_in_a_tenth_of_the_pictures_does_not_change_it() -> None:
    other = np.clip(1.2 * picture(), 0, 255).astype(np.uint8)
    moved = other.copy()
    moved[10:40, 10:46] = 250
    found = exposed(picture(), moved).astype(int)
    assert np.abs(found - other).mean() < 4


def test_a_picture_without_contrast_tells_no_gain() -> None:
    flat = np.full((30, 40, 3), 100, np.uint8)
    rng = np.random.default_rng(1)
    noisy = np.clip(flat + 10 + 2 * rng.standard_normal(flat.shape), 0, 255).astype(np.uint8)
    assert np.abs(exposed(flat, noisy).astype(int) - 110).max() <= 1
    assert np.abs(exposed(noisy, flat).astype(int) - (noisy.astype(int) - 10)).max() <= 1
