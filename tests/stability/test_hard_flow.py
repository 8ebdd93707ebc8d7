"""Hard cases of optical flow: nothing to see but noise, nothing that moves, saturated parts, too few frames."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import write_frames

from stages.flow import __main__ as flow_stage
from stages.flow import true_flow
from stages.flow.confidence import flow_confidence, variance_about_plane
from stages.flow.dis import estimate_flow
from stages.flow.edges import edge_list, long_edges
from stages.flow.noise import flow_variance
from stages.flow.options import FlowOptions
from stages.flow.passes import stored
from stages.shared.artifacts import read_dense, write_json
from stages.shared.sequences import check_sequence, sequence_to_json
from stages.shared.warp import is_inside


def textured(h: int = 96, w: int = 160) -> np.ndarray:
    """A frame [h, w] uint8 with detail of two sizes."""
    rng = np.random.default_rng(0)
    image = sum(cv2.GaussianBlur(rng.standard_normal((h, w)), (0, 0), s) * s for s in (1.5, 5))
    return cv2.normalize(image, None, 10, 245, cv2.NORM_MINMAX).astype(np.uint8)


def both_ways(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flow [h, w, 2] and its confidence [h, w]."""
    frames = np.stack([first, second])
    flow = estimate_flow(frames, edge_list(2, (1,)), 0, threads=1)
    return flow[0, 1], flow_confidence(flow[0, 1], flow[1, 0], first, second)


def test_flow_of_noise_is_not_called_right() -> None:
    """Smooth flow agrees with itself both ways where there is nothing to match: consistency alone trusts it."""
    rng = np.random.default_rng(0)
    frames = [np.clip(120 + 5 * rng.standard_normal((96, 160)), 0, 255).astype(np.uint8) for _ in range(2)]
    flow = np.full((96, 160, 2), 0.7, np.float32)
    sure = flow_confidence(flow, -flow, *frames)
    assert (sure > 0.5).mean() < 0.01
    assert (sure[5:-5, 5:-5] > 0).all()


@pytest.mark.parametrize("grey_level", [0, 255])
def test_saturated_halves_stay_finite_and_unsure(grey_level: int) -> None:
    """The structure tensor is zero there, and so is the noise: the quotient must stay finite."""
    first = textured()
    first[:, :80] = grey_level
    second = np.roll(first, 2, axis=0)
    flow, sure = both_ways(first, second)
    assert np.isfinite(flow).all()
    assert np.isfinite(sure).all()
    assert sure[20:-20, 10:60].max() < 0.5
    assert np.median(sure[20:-20, 100:-10]) > 0.7


def test_equal_frames_have_no_flow_and_full_confidence() -> None:
    """Their residual is zero everywhere, so that nothing may be divided by its median."""
    frame = textured()
    flow, sure = both_ways(frame, frame.copy())
    assert np.abs(flow).max() < 0.01
    assert np.median(sure) > 0.9


def test_smooth_flow_is_as_smooth_beside_flow_that_is_hundreds_of_pixels_faster() -> None:
    """Variances of .01 px^2 beside means of (200 px)^2: their difference in single precision is off by as much."""
    smooth = np.random.default_rng(0).normal(0, 0.05, (96, 160, 2)).astype(np.float32)
    faster = smooth + np.where(np.arange(160) < 80, 0, 400).astype(np.float32)[:, None]
    expected = variance_about_plane(smooth)[:, :70]
    np.testing.assert_allclose(variance_about_plane(faster)[:, :70], expected, rtol=1e-3)


def test_texture_within_the_rounding_of_8_bits_has_a_finite_bound() -> None:
    """A noise of zero would call every gradient of one grey level exact."""
    ramp = np.repeat(np.arange(160, dtype=np.uint8)[None] // 40 + 100, 96, axis=0)
    variance = flow_variance(ramp)
    assert np.isfinite(variance).all()
    assert variance.min() > 1


def test_frames_fewer_than_the_offsets_reach_have_the_edges_there_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three frames have no edge of 3 or 5; two frames have one level, and no far frames."""
    assert edge_list(2, (1, 2, 3, 5)) == [(0, 1), (1, 0)]
    assert long_edges({(0, 1): np.zeros((8, 8, 2), np.float32), (1, 0): np.zeros((8, 8, 2), np.float32)}, 2, 2) == []
    folder = write_frames(tmp_path / "clip", count=3)
    monkeypatch.setattr(flow_stage, "write_figure", lambda *_: None)
    write_json(tmp_path / "sequence.json", sequence_to_json(check_sequence("clip", folder)))
    flow_stage.main(tmp_path / "sequence.json", tmp_path / "pairs.arrow", tmp_path / "flow.png", FlowOptions())
    pairs = read_dense(tmp_path / "pairs.arrow")
    assert list(zip(pairs["source"], pairs["target"], strict=True)) == edge_list(3, (1, 2))


def test_inverting_flow_that_tears_leaves_the_gap_unknown() -> None:
    """Two halves that part by 6 px: nothing lands in between, and the iteration has no solution there."""
    flow = np.zeros((40, 60, 2), np.float32)
    flow[:, 30:, 0] = 6
    back, known = true_flow.inverted(
        flow, np.ones((40, 60), bool), np.ones((40, 60), np.float32), np.ones((40, 60), bool)
    )
    assert np.isfinite(back).all()
    assert not known[:, 31:35].any()
    np.testing.assert_allclose(back[:, 38:58, 0], -6, atol=1e-4)
    np.testing.assert_allclose(back[:, :28], 0, atol=1e-4)
    assert known[:, 38:58].all()


def test_long_flow_is_stored_to_a_2048th_and_what_leaves_the_frame_still_leaves_it() -> None:
    rng = np.random.default_rng(0)
    flow = rng.uniform(-160, 160, (96, 160, 2)).astype(np.float32)
    flow[0, 0], flow[-1, -1] = (1e6, -1e9), (-3e5, 160)
    kept = stored(flow).astype(np.float32)
    error = np.abs(kept - flow)[1:-1]
    assert (error <= np.maximum(np.abs(flow[1:-1]) / 2048, 1e-7)).all()
    assert abs(np.mean(kept[1:-1] - flow[1:-1])) < 1e-3  # no bias: of many pixels, nothing is left of the rounding
    assert not is_inside(kept)[[0, -1], [0, -1]].any()
