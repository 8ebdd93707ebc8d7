"""Drift of long tracks, against clips whose motion and errors are known to a hundredth of a pixel."""

import gc
import weakref

import cv2
import numpy as np
import pytest
from scipy.fft import dct
from slow_mover import FOUND, SLOW, STEP, H, T, W, cameras, evidence, frames, observed, where

from stages.motion import drift, resweep, tracks
from stages.motion.static_paths import StaticScene
from stages.motion.tracks import Tracks, batches, sampled
from stages.shared.warp import bilinear


def test_motion_below_the_noise_of_an_edge_is_found() -> None:
    """A tenth of a pixel per frame, in flow with half as much noise: no edge shows it, tracks do, and nothing else."""
    moving = np.stack([where(k) for k in range(T)])
    pairs = observed(STEP, STEP + SLOW, noise_px=0.05)
    of_edges, _, _ = resweep.camera_evidence(pairs, *cameras(), np.ones((T, H, W), np.float32))
    assert (of_edges.residual[moving] > FOUND).mean() < 0.02
    found = evidence(pairs, frames(STEP, STEP + SLOW)) > FOUND
    assert found[moving].mean() > 0.9
    assert found[~moving].mean() < 0.03  # flow leaks no further than colour edges


def test_flow_that_the_pictures_refute_is_no_motion() -> None:
    """As of shadow edges: the flow of a region drifts, and the texture of the wall stays where the camera has it."""
    pairs = observed(STEP, STEP + SLOW)
    assert (evidence(pairs, frames(STEP, None)) > FOUND).mean() < 1e-3


def test_what_most_of_the_frame_does_is_an_error_of_the_cameras() -> None:
    """Everything drifts, and turns: the pose is wrong. What drifts otherwise is found all the same."""
    everywhere = evidence(observed(STEP + SLOW, STEP + SLOW), frames(STEP + SLOW, STEP + SLOW))
    assert (everywhere > FOUND).mean() < 1e-3
    other = STEP + SLOW + [0.0, 0.15]
    rgb, moving = frames(STEP + SLOW, other), np.stack([where(k) for k in range(T)])
    assert (evidence(observed(STEP + SLOW, other), rgb) > FOUND)[moving].mean() > 0.8


def test_what_is_burnt_in_is_no_evidence() -> None:
    scene = ~where(0)
    for k in range(T):
        scene &= ~where(k)
    found = evidence(observed(STEP, STEP + SLOW, scene=scene), frames(STEP, STEP + SLOW))
    assert (found > FOUND).mean() < 1e-3


def test_slow_and_fast_parts_are_those_of_the_cosine_transform() -> None:
    random = np.random.default_rng(2)
    lengths = np.array([4, 9, 26, 49])
    first = np.concatenate([[0], np.cumsum(lengths)])
    made = Tracks(first, np.zeros(first[-1], int), np.zeros((first[-1], 2)))
    steps = [random.normal(size=(n - 1, 2)) for n in lengths]
    slow, fast = drift.slow_and_fast(made, np.concatenate(steps))
    for k, of_track in enumerate(steps):
        power = (dct(of_track, axis=0, norm="ortho") ** 2).sum(axis=1)
        count = max(1, round(len(of_track) / drift.PERIOD))
        np.testing.assert_allclose(slow[k], power[:count].sum() / (2 * count))
        np.testing.assert_allclose(fast[k], power[count:].sum() / (2 * (len(of_track) - count)))


def test_a_track_that_drifts_for_a_while_shows_motion_there_alone() -> None:
    """As a static track does past which a mover walks: its other sightings are no evidence."""
    made = Tracks(np.array([0, 24, 54]), np.zeros(54, int), np.zeros((54, 2)))
    dragged = np.zeros((29, 2))
    dragged[15:] = [0.3, -0.2]
    random = np.random.default_rng(4)
    steps = [np.tile([0.0, 0.1], (23, 1)) + random.normal(0, 0.02, (23, 2)), dragged]
    share = drift.share_here(made, np.concatenate(steps))
    steady, left = np.split(share, [24])
    assert (steady > 0.5).all()
    assert (left[:10] < drift.HERE / 10).all()
    assert (left[18:] > 1).all()
    for k, of_track in enumerate(steps):
        at = np.arange(len(of_track))
        weights = np.exp(-((at[:, None] - at) ** 2) / (2 * drift.AROUND**2))
        weights[np.abs(at[:, None] - at) > 3 * drift.AROUND] = 0
        power = ((weights @ of_track / weights.sum(axis=1, keepdims=True)) ** 2).sum(axis=1)
        at_ends = np.concatenate([power[:1], (power[1:] + power[:-1]) / 2, power[-1:]])
        np.testing.assert_allclose(share[made.track == k], at_ends / power.mean(), rtol=1e-6, atol=1e-9)


def test_tracks_follow_the_flow_and_cover_the_frames() -> None:
    pairs = observed(STEP, STEP + SLOW)
    covered = np.zeros((T, H, W), bool)
    for batch in batches(pairs, T):
        assert (batch.lengths >= tracks.MIN_FRAMES).all()
        steps = np.delete(np.diff(batch.frame), batch.first[1:-1] - 1)
        assert (steps == 1).all()
        inner = ((batch.uv[:, 0] > 112) | (batch.uv[:, 0] < 40)).nonzero()[0]  # beside the mover and its path
        inner = inner[np.isin(inner + 1, inner) & ~np.isin(inner + 1, batch.first)]
        np.testing.assert_allclose(batch.uv[inner + 1] - batch.uv[inner], np.tile(STEP, (len(inner), 1)), atol=1e-6)
        u, v = np.rint(batch.uv).astype(int).T
        covered[batch.frame, v, u] = True
    near = cv2.dilate(covered[T // 2].astype(np.uint8), np.ones((11, 11), np.uint8))
    assert near.mean() > 0.95


def test_what_the_static_scene_keeps_is_gone_with_its_last_use() -> None:
    """50 frames of it are a hundred megabytes; a cycle of references would hold them until Python looks for cycles."""
    ones = np.ones((T, H, W), np.float32)
    scene = StaticScene(observed(STEP, STEP), frames(STEP, None), cameras(), ones, 0 * ones)
    gc.disable()
    try:
        kept = weakref.ref(scene.around(0).detail)
        assert kept() is not None
        del scene
        assert kept() is None
    finally:
        gc.enable()


@pytest.mark.parametrize("shape", [(9, 13), (9, 13, 2)])
def test_sampling_is_bilinear(shape: tuple[int, ...]) -> None:
    random = np.random.default_rng(3)
    field, uv = random.normal(size=shape), random.uniform(0, 1, (50, 2)) * [12, 8]
    uv[:2] = [[12, 8], [0, 0]]
    np.testing.assert_allclose(sampled(field, uv), bilinear(field, uv), atol=0.1)  # OpenCV rounds to 1/32 px
    v, u = np.mgrid[:9, :13]
    np.testing.assert_allclose(sampled(2.0 * u - v, uv), 2 * uv[:, 0] - uv[:, 1], atol=1e-9)
