"""Superpixels, and what links them: shared borders, and matches of the flow."""

import numpy as np
import pytest

from stages.segment import permanence
from stages.segment.superpixels import Superpixels, borders, matches, superpixels


def test_links_count_borders_and_matches() -> None:
    labels = np.array([[[0, 0, 1, 1]] * 4, [[0, 0, 1, 1]] * 4], np.int32)
    pixels = Superpixels(labels, np.array([0, 2, 4]), np.full(4, 8.0), np.zeros((4, 3)))
    np.testing.assert_array_equal(borders(pixels).toarray(), np.kron(np.eye(2), [[0, 4], [4, 0]]))
    flow = np.zeros((1, 4, 4, 2), np.float32)
    flow[..., 0] = 2  # the left half goes to the right one, the right half leaves the frame
    pairs = {"source": np.array([0]), "target": np.array([1]), "flow": flow, "confidence": np.full((1, 4, 4), 0.5)}
    expected = np.zeros((4, 4))
    expected[0, 3] = expected[3, 0] = 0.5 * 8
    np.testing.assert_array_equal(matches(pixels, pairs).toarray(), expected)
    assert matches(pixels, pairs | {"target": np.array([9])}).nnz == 0


def test_links_are_weaker_between_other_colours() -> None:
    labels = np.array([[[0, 0, 1, 1]] * 4] * 2, np.int32)
    colours = np.zeros((4, 3))
    colours[3] = 20
    pixels = Superpixels(labels, np.array([0, 2, 4]), np.full(4, 8.0), colours)
    pairs = {"source": np.array([0]), "target": np.array([1])}
    pairs |= {"flow": np.zeros((1, 4, 4, 2), np.float32), "confidence": np.ones((1, 4, 4))}
    found = permanence.link_weights(pixels, pairs, 0, 3.0).toarray()
    assert found[0, 2] == pytest.approx(3 * 8)
    assert found[1, 3] == pytest.approx(3 * 8 * np.exp(-3 * 20**2 / (2 * 20**2)))
    assert found[2, 3] == pytest.approx(2.4 * 4 * (4 / 512) * np.exp(-3 * 20**2 / (2 * 8**2)))


def test_matches_follow_vertical_flow_between_near_frames_only() -> None:
    labels = np.array([[[0] * 4] * 2 + [[1] * 4] * 2] * 5, np.int32)
    pixels = Superpixels(labels, np.arange(0, 11, 2), np.full(10, 8.0), np.zeros((10, 3)))
    flow = np.zeros((1, 4, 4, 2), np.float32)
    flow[..., 1] = 2
    pairs = {"source": np.array([0]), "target": np.array([3]), "flow": flow, "confidence": np.ones((1, 4, 4))}
    found = matches(pixels, pairs)
    assert found[0, 7] == 8
    assert found.nnz == 2
    assert matches(pixels, pairs | {"target": np.array([4])}).nnz == 0
    assert matches(pixels, pairs | {"confidence": np.full((1, 4, 4), 0.04)}).nnz == 0


def test_matches_count_pixels_between_frames_of_unequal_numbers() -> None:
    rng, counts = np.random.default_rng(0), (3, 700, 5)
    labels = np.stack([rng.integers(0, n, (12, 14)).astype(np.uint16) for n in counts])
    first = np.concatenate([[0], np.cumsum(counts)])
    flow, confidence = rng.integers(-3, 4, (2, 12, 14, 2)), rng.random((2, 12, 14))
    pairs = {"source": np.array([0, 2]), "target": np.array([1, 0]), "flow": flow, "confidence": confidence}
    expected = np.zeros((first[-1], first[-1]))
    for e, v, u in np.ndindex(2, 6, 7):
        (i, j), here = (pairs[end][e] for end in ("source", "target")), (2 * v + 1, 2 * u + 1)
        y, x = here + flow[e][here][::-1]
        if 0 <= x < 14 and 0 <= y < 12 and confidence[e][here] > 0.05:
            a, b = first[i] + labels[i][here], first[j] + labels[j][y, x]
            expected[a, b] += 4 * confidence[e][here]
            expected[b, a] += 4 * confidence[e][here]
    pixels = Superpixels(labels, first, np.ones(first[-1]), np.zeros((first[-1], 3)))
    np.testing.assert_allclose(matches(pixels, pairs).toarray(), expected, rtol=1e-6)


@pytest.mark.parametrize("size", [(1, 40), (3, 20), (4, 4), (8, 8), (20, 30)])
def test_superpixels_of_tiny_frames_cover_every_pixel(size: tuple[int, int]) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (2, *size, 3)).astype(np.uint8)
    pixels = superpixels(2, lambda k: rgb[k])
    assert pixels.areas.sum() == 2 * size[0] * size[1]
    assert len(pixels.areas) == pixels.first[-1] == len(pixels.colours)
