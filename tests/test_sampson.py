"""The Sampson distance against OpenCV's."""

import cv2
import numpy as np
import pytest

from stages.shared import lie
from stages.shared.sampson import sampson_distances


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_sampson_distances_equal_opencv(kind: type[np.floating]) -> None:
    rng = np.random.default_rng(0)
    F = lie.skew(np.array([0.9, 0.1, 0.3])) @ lie.exp_so3(np.array([0.02, -0.05, 0.01]))
    x, y = rng.uniform(-0.5, 0.5, (2, 4, 5, 2)).astype(kind)
    found = sampson_distances(F.T, y, x)  # the transpose lies otherwise in memory
    assert found.dtype == kind
    assert found.shape == (4, 5)
    ends = [np.concatenate([part.reshape(-1, 2), np.ones((20, 1))], axis=1) for part in (x, y)]
    expected = [np.sqrt(cv2.sampsonDistance(*pair, F)) for pair in zip(*ends, strict=True)]
    sides = np.sign(np.einsum("ni,ij,nj->n", ends[1], F, ends[0]))
    np.testing.assert_allclose(found.ravel(), sides * expected, rtol=2e-6 if kind == np.float32 else 1e-12)


def test_a_match_at_both_epipoles_has_no_distance() -> None:
    F = lie.skew(np.array([0.0, 0.0, 1.0]))
    assert sampson_distances(F, np.zeros((1, 2)), np.zeros((1, 2))) == 0
