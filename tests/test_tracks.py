"""Tracks of dynamic pixels through training frames only, their depth, and the spread of control points over them."""

import tracemalloc

import numpy as np
import pytest
from square_inputs import HELD_OUT
from track_tables import table

from stages.control import canonical, sightings, tracks
from stages.shared.split import SplitOptions, held_out
from stages.shared.warp import bilinear

F, H, W = 9, 48, 64
STEP = np.array([2.0, 1.0])  # pixels per frame of the moving block


def block_masks(T: int = F) -> np.ndarray:
    """A block of 16 x 12 px that moves by STEP from (6, 8)."""
    masks = np.zeros((T, H, W), bool)
    for k in range(T):
        u, v = (np.array([6, 8]) + k * STEP).astype(int)
        masks[k, v : v + 12, u : u + 16] = True
    return masks


def block_edges(T: int = F, reach: int = 2) -> dict[str, np.ndarray]:
    """Exact flow of the block on a still background, over all edges up to `reach` frames long."""
    pairs = [(i, j) for i in range(T) for j in range(T) if 0 < abs(i - j) <= reach]
    masks = block_masks(T)
    flow = np.stack([masks[i][..., None] * STEP * (j - i) for i, j in pairs]).astype(np.float16)
    source, target = np.array(pairs).T
    return {"source": source, "target": target, "flow": flow}


def training(T: int = F) -> np.ndarray:
    return ~held_out(T, SplitOptions())


def test_tracks_follow_the_block_over_the_held_out_frame() -> None:
    links = tracks.training_links(**block_edges(), is_training=training())
    assert HELD_OUT not in links.frames
    assert links.missing == []
    found = tracks.track_dynamic_pixels(links, block_masks()[links.frames], stride_px=2)
    uv, visible = table(found)
    full = visible.all(axis=1)
    assert full.sum() > 20
    moved = uv[full] - uv[full][:, :1]
    np.testing.assert_allclose(moved, np.broadcast_to((links.frames[:, None]) * STEP, moved.shape), atol=1e-3)


def test_no_edge_that_touches_a_held_out_frame_is_read() -> None:
    edges = block_edges()
    touched = (edges["source"] == HELD_OUT) | (edges["target"] == HELD_OUT)
    edges["flow"][touched] = np.nan
    links = tracks.training_links(**edges, is_training=training())
    assert np.isfinite(links.flow[links.rows]).all()


def test_a_missing_skip_edge_is_named_and_ends_the_tracks() -> None:
    links = tracks.training_links(**block_edges(reach=1), is_training=training())
    assert sorted(links.missing) == [(3, 5), (5, 3)]
    found = tracks.track_dynamic_pixels(links, block_masks()[links.frames], stride_px=2)
    before, after = links.frames < HELD_OUT, links.frames > HELD_OUT
    visible = table(found)[1]
    assert not (visible[:, before].any(axis=1) & visible[:, after].any(axis=1)).any()


@pytest.mark.parametrize(("error_px", "survive"), [(0.7, True), (1.5, False)])
def test_tracks_end_where_flow_and_flow_back_disagree(error_px: float, survive: bool) -> None:
    edges = block_edges()
    back = (edges["source"] == 7) & (edges["target"] == 6)
    edges["flow"][back, ..., 1] += error_px
    links = tracks.training_links(**edges, is_training=training())
    _, visible = table(tracks.track_dynamic_pixels(links, block_masks()[links.frames], stride_px=2))
    started_before = visible[:, links.frames == 1].any(axis=1)
    assert started_before.any()
    assert visible[started_before][:, links.frames >= 7].any() == survive


def test_more_tracks_than_opencv_has_rows_are_sampled() -> None:
    ramp = np.broadcast_to(np.arange(W, dtype=np.float32), (H, W))
    uv = np.random.default_rng(0).uniform(0, H - 1, (70_000, 2))
    np.testing.assert_allclose(bilinear(ramp, uv), uv[:, 0], atol=0.02)  # OpenCV's steps of 1/32 px


def test_short_tracks_are_kept_where_no_long_one_passes() -> None:
    links = tracks.training_links(**block_edges(), is_training=training())
    masks = block_masks()[links.frames]
    masks[2:4, 30:40, 40:52] = True  # another part, in sight for two frames
    uv, visible = table(tracks.track_dynamic_pixels(links, masks, stride_px=2))
    short = visible.sum(axis=1) == 2
    assert short.sum() > 10
    assert (uv[short][visible[short]][:, 0] >= 40).all()


def test_a_part_that_shows_up_late_gets_tracks() -> None:
    masks = block_masks()
    masks[6:, 38:46, 44:60] = True
    links = tracks.training_links(**block_edges(), is_training=training())
    uv, visible = table(tracks.track_dynamic_pixels(links, masks[links.frames], stride_px=2))
    late = visible & (uv[..., 1] > 36) & (uv[..., 0] > 42)
    assert late.any()
    assert not late[:, links.frames < 6].any()


def test_depth_is_smoothed_as_far_as_it_is_uncertain() -> None:
    rng = np.random.default_rng(0)
    truth = np.linspace(1.0, 1.3, 12)
    std = np.full((2, 12), 0.5)
    std[1] = 0.01
    measured = truth + rng.normal(0, 1, (2, 12)) * [[0.2], [0.01]]
    visible = np.ones((2, 12), bool)
    visible[:, 5] = False
    measured[:, 5] = 99.0
    smoothed = sightings.smooth_log_depth(measured, std, visible)
    assert np.abs(np.diff(smoothed[0], n=2)).max() < 0.02 < np.abs(np.diff(measured[0], n=2)).max()
    np.testing.assert_allclose(smoothed[1], truth, atol=0.03)


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_depth_of_short_clips_is_smoothed_too(frames: int) -> None:
    visible = np.zeros((2, frames), bool)
    visible[:, 0] = True
    smoothed = sightings.smooth_log_depth(np.full((2, frames), 0.7), np.full((2, frames), 0.1), visible)
    np.testing.assert_allclose(smoothed, 0.7, atol=1e-9)


def test_smoothing_solves_its_normal_equations_in_memory_linear_in_the_frames() -> None:
    rng = np.random.default_rng(0)
    for frames in (7, 4000):
        measured, visible = rng.normal(size=(1, frames)), rng.random((1, frames)) < 0.5
        visible[0, 0] = True
        tracemalloc.start()
        z = sightings.smooth_log_depth(measured, np.full((1, frames), 0.3), visible)[0]
        assert tracemalloc.get_traced_memory()[1] < 5e6 + 2000 * frames  # a matrix of all frames has 8 * frames^2
        tracemalloc.stop()
        bent = np.diff(np.pad(np.diff(z, n=2), 2), n=2) / sightings.DEPTH_ACCELERATION**2
        steep = -np.diff(np.pad(np.diff(z), 1)) / sightings.DEPTH_SPEED**2
        np.testing.assert_allclose(bent + steep + visible[0] * (z - measured[0]) / 0.3**2, 0, atol=1e-6)


def test_the_canonical_frame_sees_most_of_the_tracks() -> None:
    visible = np.zeros((10, 6), bool)
    visible[:5, :4] = True
    visible[5:, 3:] = True
    assert canonical.choose_frames((visible * visible.sum(axis=1, keepdims=True)).sum(axis=0)) == (3, 0)


def test_farthest_points_are_spread_and_denser_where_it_matters() -> None:
    line = np.stack([np.linspace(0, 1, 401), np.zeros(401), np.zeros(401)], axis=-1)
    even = line[canonical.farthest_points(line, np.ones(401), 21), 0]
    assert np.diff(np.sort(even)).max() < 3 * np.diff(np.sort(even)).min()
    importance = np.where(line[:, 0] > 0.5, 3.0, 1.0)
    chosen = line[canonical.farthest_points(line, importance, 40), 0]
    assert (chosen > 0.5).sum() > 2 * (chosen <= 0.5).sum()
