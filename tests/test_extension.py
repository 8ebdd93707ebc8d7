"""What is known of some pixels, extended to those around, against SciPy's Gaussian."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from stages.segment.extension import extend, weigh


@pytest.mark.parametrize("channels", [1, 2])
def test_a_mean_is_that_of_a_gaussian_of_what_is_known(channels: int) -> None:
    rng = np.random.default_rng(0)
    values, weight = rng.normal(size=(30, 40, channels)).astype(np.float32), rng.random((30, 40), np.float32)
    weight[:, 20:] = 0  # nothing is known there
    means, share = extend(weigh(values, weight), 1.5)
    expected = gaussian_filter(weight, 1.5, mode="constant")
    np.testing.assert_allclose(share, expected, atol=1e-5)
    for c in range(channels):
        of_channel = gaussian_filter(weight * values[..., c], 1.5, mode="constant")
        np.testing.assert_allclose(means[:, :25, c], of_channel[:, :25] / expected[:, :25], atol=1e-2)
    assert not means[:, 30:].any()
