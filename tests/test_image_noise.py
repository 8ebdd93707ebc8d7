"""How loud the noise of a picture is, and what is smoothed for it."""

import cv2
import numpy as np
import pytest

from stages.shared.image_noise import LOUD, MOST_PX, blur_of_noise, noise_variance, smoothed


def picture(sigma: float) -> np.ndarray:
    """Texture of some pixels [h, w, 3] uint8 with noise of this standard deviation in levels."""
    random = np.random.default_rng(0)
    texture = cv2.GaussianBlur(random.normal(128, 90, (90, 120, 1)), (0, 0), 1.5)[..., None]
    return np.clip(texture + sigma * random.standard_normal((90, 120, 1)), 0, 255).astype(np.uint8).repeat(3, axis=2)


@pytest.mark.parametrize("sigma", [6.0, 9.0, 14.0])
def test_loud_noise_is_measured_and_smoothed_away(sigma: float) -> None:
    noisy = picture(sigma)
    assert np.sqrt(noise_variance(noisy[..., 0])) == pytest.approx(sigma, rel=0.15)
    noise = smoothed(noisy, blur_of_noise(noisy)).astype(float) - smoothed(picture(0), blur_of_noise(noisy))
    assert noise.std() < 2


@pytest.mark.parametrize("saturated", [0, 255])
def test_what_is_saturated_shows_no_noise_and_hides_none(saturated: int) -> None:
    noisy = picture(12.0)
    whole = blur_of_noise(noisy)
    noisy[:60] = saturated
    assert blur_of_noise(noisy) == pytest.approx(whole, rel=0.2)
    assert blur_of_noise(np.full_like(noisy, saturated)) == 0


def test_pictures_are_never_smoothed_beyond_recognition() -> None:
    checks = np.indices((90, 120)).sum(axis=0) % 2 * 200 + 20
    assert blur_of_noise(np.dstack(3 * [checks]).astype(np.uint8)) == MOST_PX


def test_texture_in_daylight_is_not_smoothed() -> None:
    """It looks like some noise; a picture that is not loud comes back as it is."""
    fine = picture(0.7 * LOUD)
    assert noise_variance(fine[..., 0]) > 1
    assert blur_of_noise(fine) == 0
    assert smoothed(fine, 0.0) is fine
