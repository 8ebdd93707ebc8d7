"""The light's normal equations with samples whose weights have all but vanished."""

import numpy as np

from stages.scene import light


def test_a_sample_of_nearly_no_weight_does_not_spoil_the_gains() -> None:
    """The inverse of its weight, a denormal number, is infinite in float32."""
    rng = np.random.default_rng(0)
    weight = np.ones((20, 4, 3), np.float32)
    slope, error = (rng.standard_normal(weight.shape).astype(np.float32) for _ in range(2))
    weight[0] = 1e-40
    assert np.isfinite(light._solve(weight, slope, error, [], 1, 1e-3)).all()
