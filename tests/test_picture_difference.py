"""What two pictures of one thing may differ by."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from stages.shared import picture_difference
from stages.shared.picture_difference import EVERY_PX, exposed, noise_of, tolerance


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


def matched(sigma: np.ndarray | float, wrong: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A noisy picture, how far two others are apart from it, and where they are known; a share of the matches is wrong.

    Args:
        sigma: standard deviation of the noise of each colour, in levels.
    """
    rng, clean = np.random.default_rng(2), picture()
    frame, *others = (np.clip(clean + sigma * rng.standard_normal(clean.shape), 0, 255) for _ in range(3))
    apart = np.stack([np.abs(frame - other).mean(axis=2)[::EVERY_PX, ::EVERY_PX] for other in others])
    apart[rng.random(apart.shape) < wrong] = 90
    inside = rng.random(apart.shape) < 0.9
    apart[~inside] = np.nan
    return frame.astype(np.uint8), apart, inside


@pytest.mark.parametrize("wrong", [0.0, 0.25])
def test_noise_is_measured_by_brightness(wrong: float) -> None:
    """Bright pixels have more of it, as those of a sensor; the mean of |a - b| is 2 / sqrt(pi) of their deviations."""
    sigma = np.maximum(picture().mean(axis=2, keepdims=True) - 60, 4) / 6
    frame, apart, inside = matched(sigma, wrong)
    found, slopes = noise_of(frame, apart, inside), tolerance(frame) - picture_difference.TOLERANCE[0]
    expected = 2 / np.sqrt(np.pi) * sigma[..., 0]
    bright = sigma[..., 0] > np.quantile(sigma, 0.8)
    dark = sigma[..., 0] < np.quantile(sigma, 0.2)
    for part in (bright, dark):
        assert np.median((found + slopes)[part]) == pytest.approx(np.median(expected[part]), rel=0.3)
    assert np.median(found[bright]) > 1.3 * np.median(found[dark])


def test_a_good_picture_has_no_noise_that_counts() -> None:
    frame, apart, inside = matched(0.5)
    assert_array_equal(tolerance(frame, noise_of(frame, apart, inside)), tolerance(frame))
    nothing = noise_of(frame, apart[:0], inside[:0])
    assert not nothing.any()
    assert not noise_of(frame, apart, np.zeros_like(inside)).any()


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
        assert picture_difference._line(here, there, np.full((6, 256), 9)) == expected
