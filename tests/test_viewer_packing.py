"""The arrays that the viewer's page holds: their precision, their layout, and what they take of a large scene."""

import base64
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from viewed_scenes import with_every_effect

from stages.viewer.packing import (
    MOTION_BYTES,
    SHADOW_BYTES,
    moments_of_motion,
    packed_shadows,
    quantised_pairs,
    quantised_sh,
    to_blob,
)
from stages.viewer.page import PICTURE_BUDGET_BYTES, encoded, render_page


def test_the_page_of_50_000_gaussians_and_50_frames_is_below_8_mb() -> None:
    """With harmonics of degree 2, the most that a scene is given, a thousand control points, every fifth Gaussian
    moving, and some under moving shadows."""
    random, N, D, P, T = np.random.default_rng(0), 50_000, 10_000, 1000, 50
    halves = {"quats": (N, 4), "shapes": (N, 4), "sh_dc": (N, 3), "motions": (T, P, 10)}
    arrays = {name: random.normal(size=shape).astype(np.float16) for name, shape in halves.items()}
    arrays |= {"means": random.normal(size=(N, 3)).astype(np.float32), "instances": np.zeros(D, np.uint8)}
    arrays |= {"sh_rest": np.zeros((N, 8, 3), np.int8), "points": np.zeros((P, 3), np.float32)}
    arrays |= {
        "shadows": np.zeros((SHADOW_BYTES // 8000, 8000), np.int8),
        "shadow_colours": np.zeros((8000, 3), np.int8),
    }
    arrays |= {"index": np.zeros((D, 4), np.uint16), "weights": np.zeros((D, 4), np.uint8)}
    noise = [random.integers(0, 255, (1, 27, 64, 3), np.uint8).repeat(8, 1).repeat(10, 2)[0] for _ in range(T)]
    pictures = encoded(image[..., :3] for image in noise)
    assert sum(map(len, pictures)) < PICTURE_BUDGET_BYTES
    assert len(render_page("large", arrays, {}, (640, 216), pictures).encode()) < 8e6


@pytest.mark.parametrize(("T", "P", "moments"), [(50, 1000, 50), (1000, 1000, 120), (1000, 100, 1000)])
def test_motions_of_a_long_clip_are_packed_at_fewer_moments(T: int, P: int, moments: int) -> None:
    scene: Any = SimpleNamespace(deformation=SimpleNamespace(points=np.zeros((P, 3))))
    found = moments_of_motion(scene, np.linspace(0, 1, T))
    np.testing.assert_allclose(found, np.linspace(0, 1, moments))
    assert 20 * P * len(found) <= MOTION_BYTES


@pytest.mark.parametrize("T", [10, 40_000])
def test_gaussians_under_shadows_come_last_of_the_static_ones(T: int) -> None:
    """What is added to their colours, at fewer moments than frames where these take too much."""
    scene, times = with_every_effect(), np.linspace(0, 1, T)
    order, shadows, colours, step = packed_shadows(scene, times)
    n, B = scene.n_static, shadows.shape[1]
    assert scene.shadows is not None
    assert 0 < B < n
    first = scene.shadows.of_static(scene.means[:n], 0.0).detach()
    assert np.array_equal(order[n - B : n], scene.shadows.rows[first.abs().sum(dim=1) > 0])
    assert np.array_equal(np.sort(order), np.arange(len(scene.anchors)))
    assert shadows.nbytes <= SHADOW_BYTES
    shown = first[first.abs().sum(dim=1) > 0].numpy()
    assert np.abs(shadows[0, :, None] / 127 * step * (colours / 127) - shown).max() < step / 100


def test_packed_weights_sum_to_one_and_lose_little() -> None:
    random = np.random.default_rng(0)
    weights = random.dirichlet(np.full(16, 0.3), size=500)
    index = random.permuted(np.tile(np.arange(300), (500, 1)), axis=1)[:, :16]
    packed_index, packed = quantised_pairs(index, weights)
    assert (packed.sum(axis=1, dtype=int) == 255).all()
    assert (np.diff(packed.astype(int), axis=1) <= 1).all()  # heaviest first, up to rounding
    back, there = np.zeros((500, 300)), np.zeros((500, 300))
    np.put_along_axis(back, packed_index.astype(int), packed / 255, axis=1)
    np.put_along_axis(there, index, weights, axis=1)
    assert np.abs(back - there).max() <= 1 / 255


def test_packed_harmonics_err_by_half_a_step() -> None:
    rest = np.random.default_rng(0).normal(size=(100, 3, 3)).astype(np.float32)
    rest[:, 1] = 0
    packed, steps = quantised_sh(rest)
    assert np.abs(packed / 127 * steps - rest).max() <= steps.max() / 254 * 1.001


def test_the_blob_holds_what_its_layout_says() -> None:
    arrays = {"a": np.arange(5, dtype=np.uint8), "b": np.arange(6, dtype=np.float32).reshape(2, 3)}
    text, layout = to_blob(arrays)
    content = base64.b64decode(text)
    for name, array in arrays.items():
        about = layout[name]
        assert about["at"] % 4 == 0
        read = np.frombuffer(content, about["type"], array.size, about["at"]).reshape(about["shape"])
        assert np.array_equal(read, array)
