"""Looking values up at pixels."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from stages.shared.warp import bilinear, warp


@pytest.mark.parametrize("shape", [(0,), (50,), (40_000,), (7, 9)])
def test_bilinear_equals_scipy_at_opencvs_steps(shape: tuple[int, ...]) -> None:
    """40,000 pixels in a row are more than OpenCV takes at once. The border continues outside."""
    rng = np.random.default_rng(0)
    image = rng.random((20, 30, 2))
    uv = np.rint(32 * rng.uniform(-3, [32, 22], (*shape, 2))) / 32
    expected = [map_coordinates(image[..., c], [uv[..., 1], uv[..., 0]], order=1, mode="nearest") for c in range(2)]
    found = bilinear(image, uv)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, np.stack(expected, axis=-1), atol=1e-6)
    single = bilinear(image[..., 0].astype(np.float16), uv)
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, expected[0], atol=1e-3)


def test_every_third_pixel_is_sampled_as_in_the_whole() -> None:
    rng = np.random.default_rng(0)
    image, flow = rng.integers(0, 256, (20, 31, 3), np.uint8), rng.uniform(-6, 6, (20, 31, 2)).astype(np.float32)
    np.testing.assert_array_equal(warp(image, flow, 3), warp(image, flow)[::3, ::3])
