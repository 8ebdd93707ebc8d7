"""Optical flow: the edges, the matches against exact motion, and what the confidence promises."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import write_frames

from stages.flow import __main__ as flow_stage
from stages.flow.confidence import flow_confidence, variance_about_plane
from stages.flow.dis import chained, estimate_flow
from stages.flow.edges import edge_list, long_edges, path
from stages.flow.options import FlowOptions
from stages.shared import sintel
from stages.shared.artifacts import read_dense, read_metadata, write_json
from stages.shared.sequences import check_sequence, sequence_to_json
from stages.shared.warp import is_inside, warp


def texture(h: int, w: int, seed: int = 0) -> np.ndarray:
    """Smooth random texture [h, w] uint8 with detail of several sizes."""
    rng = np.random.default_rng(seed)
    image = sum(cv2.GaussianBlur(rng.standard_normal((h, w)), (0, 0), s) * s for s in (1.5, 4, 10))
    return cv2.normalize(image, None, 20, 230, cv2.NORM_MINMAX).astype(np.uint8)


def shifted_frames(T: int, step: tuple[int, int], size: tuple[int, int] = (96, 160)) -> np.ndarray:
    """Frames [T, h, w] cut from one texture; everything moves by `step` = (u, v) px per frame."""
    h, w = size
    reach = T * max(map(abs, step))
    wide = texture(h + 2 * reach, w + 2 * reach)
    corner = [(reach - k * step[1], reach - k * step[0]) for k in range(T)]
    return np.stack([wide[y : y + h, x : x + w] for y, x in corner])


def test_edges_go_both_ways_and_are_sorted() -> None:
    edges = edge_list(4, (1, 3))
    assert edges == [(0, 1), (0, 3), (1, 0), (1, 2), (2, 1), (2, 3), (3, 0), (3, 2)]


def test_chaining_composes_known_flow() -> None:
    """Displacements of one scene point add up along the way, read where the point has gone (to OpenCV's 1/32 px)."""
    h, w = 20, 30
    ramp = np.zeros((h, w, 2), np.float32)
    ramp[..., 0] = 0.1 * np.arange(w)
    total = chained({(0, 1): ramp, (1, 2): ramp}, [(0, 1), (1, 2)])
    assert total is not None
    u = np.arange(w)[: w // 2]
    np.testing.assert_allclose(total[5, : w // 2, 0], 0.1 * u + 0.1 * (1.1 * u), atol=0.1 / 32)


def test_paths_take_the_longest_steps_that_exist() -> None:
    known = {*edge_list(9, (1, 3)), (0, 5)}
    assert path(known, (5, 3, 1), (0, 7)) == [(0, 5), (5, 6), (6, 7)]
    assert path(known, (5, 3, 1), (7, 0)) == [(7, 4), (4, 1), (1, 0)]
    assert path({(0, 2), (2, 4)}, (2,), (0, 3)) is None


def constant_flow(T: int, step: float, size: tuple[int, int] = (64, 96)) -> dict[tuple[int, int], np.ndarray]:
    """Flow of a sideways shift by `step` px per frame over edges of 1 and 4 frames."""
    return {(i, j): np.full((*size, 2), (step * (j - i), 0), np.float32) for i, j in edge_list(T, (1, 4))}


def test_long_edges_lead_as_far_as_the_picture_stays_in_view() -> None:
    """At 4 px per frame, 96 px wide, a third of the picture is left after 16 frames (64 px), less after 24."""
    edges = long_edges(constant_flow(40, 4.0), 40, 1)
    onward = [(i, j) for i, j in edges if j > i]
    assert onward == [*((i, i + 16) for i in range(24)), *((i, i + 12) for i in range(24, 28))] + [
        (i, i + 8) for i in range(28, 32)
    ]
    assert sorted((j, i) for i, j in onward) == sorted((i, j) for i, j in edges if j < i)
    assert not long_edges(constant_flow(40, 10.0), 40, 1)
    assert not long_edges(constant_flow(40, 4.0), 40, 0)


def test_long_edges_need_flow_that_agrees_both_ways() -> None:
    flow = constant_flow(20, 0.5)
    for (i, j), there in flow.items():
        if j < i:
            there[:48] += 3
    assert not long_edges(flow, 20, 2)


@pytest.mark.parametrize("per_frame", [1, 2])
def test_long_edges_grow_linearly_with_frames(per_frame: int) -> None:
    """A camera at rest sees everything everywhere: the bound per frame holds, not the number of pairs."""
    counts = [len(long_edges(constant_flow(T, 0.0, (16, 16)), T, per_frame)) for T in (100, 200)]
    assert counts[1] - counts[0] == 100 * 2 * per_frame


@pytest.mark.parametrize("step", [(2, 1), (-7, 3)])
def test_flow_of_a_shift_is_the_shift(step: tuple[int, int]) -> None:
    frames = shifted_frames(4, step)
    flow = estimate_flow(frames, edge_list(4, (1, 3)), 0, threads=1)
    for (i, j), found in flow.items():
        error = np.linalg.norm(found - np.array(step) * (j - i), axis=-1)
        assert np.median(error) < 0.1
        assert (error[is_inside(found)] < 1).mean() > 0.95


def test_long_edges_reach_further_by_chaining() -> None:
    """40 px in one go is lost on a small frame; five steps of 8 px are not."""
    frames = shifted_frames(6, (8, 0))
    alone = estimate_flow(frames, [(0, 5)], 0, threads=1)[0, 5]
    guided = estimate_flow(frames, [*edge_list(6, (1,)), (0, 5)], 0, threads=1)[0, 5]

    def right(flow: np.ndarray) -> float:
        return float((np.linalg.norm(flow - (40, 0), axis=-1) < 1)[:, :110].mean())

    assert right(guided) > 0.9
    assert right(guided) >= right(alone)


def test_threads_do_not_change_the_result() -> None:
    frames, edges = shifted_frames(4, (3, -2)), edge_list(4, (1, 2))
    one, two = (estimate_flow(frames, edges, 1, threads) for threads in (1, 2))
    assert all(np.array_equal(one[edge], two[edge]) for edge in edges)


def test_confidence_is_zero_outside_and_low_where_the_ways_disagree() -> None:
    source, target = shifted_frames(2, (4, 0))
    flow = np.full((*source.shape, 2), (4.0, 0.0), np.float32)
    back = -flow
    back[40:60, 60:100] = (9, 9)
    confidence = flow_confidence(flow, back, source, target)
    assert (confidence[:, -4:] == 0).all()
    assert confidence[45:55, 65:90].max() < 0.05
    assert np.median(confidence[:30, :150]) > 0.9


def test_confidence_survives_a_change_of_exposure_but_not_a_mismatch() -> None:
    source, target = shifted_frames(2, (4, 0))
    flow = np.full((*source.shape, 2), (4.0, 0.0), np.float32)
    brighter = np.clip(target.astype(int) + 20, 0, 255).astype(np.uint8)
    painted = target.copy()
    painted[30:60, 40:80] = 255 - painted[30:60, 40:80]
    assert np.median(flow_confidence(flow, -flow, source, brighter)) > 0.9
    assert flow_confidence(flow, -flow, source, painted)[35:55, 45:70].mean() < 0.5


def both_ways(flow: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Confidence of flow to a grey frame that leads back, where the source shows what it leads to."""
    source = warp(target.astype(np.float32), flow).round().astype(np.uint8)
    return flow_confidence(flow, -flow, source, target)


def test_near_ground_is_confident_and_a_motion_boundary_is_not() -> None:
    """Of ground that a camera passes, flow grows by as much from row to row as elsewhere at a boundary."""
    target = texture(96, 160)
    sheared = np.maximum(np.arange(96) - 40, 0) * np.float32(0.4)  # ground below the horizon
    stepped = np.where(np.arange(96) < 48, 0, 4).astype(np.float32)
    confidence = {}
    for name, across in (("ground", sheared), ("boundary", stepped)):
        flow = np.zeros((96, 160, 2), np.float32)
        flow[..., 0] = across[:, None]
        confidence[name] = both_ways(flow, target)[:, 20:120]
    assert np.median(confidence["ground"][50:85]) > 0.9
    assert confidence["boundary"][46:50].max() < 0.1
    assert np.median(confidence["boundary"][:42]) > 0.9


def test_roughness_is_what_an_affine_fit_leaves() -> None:
    """Against least squares, for flow that shears along and across by up to 100 px; and fast flow may be rougher."""
    rng, (v, u) = np.random.default_rng(0), np.mgrid[:24, :30].astype(np.float32)
    flow = np.stack([100 + 3 * v - 2 * u, 1.5 * u - v], axis=-1) + rng.normal(0, 0.3, (24, 30, 2)).astype(np.float32)
    found = variance_about_plane(flow)
    fit = np.stack([np.ones(49), *(axis[:7, :7].ravel() for axis in (v, u))], axis=1)
    for row, column in ((3, 3), (9, 20), (20, 26)):
        window = flow[row - 3 : row + 4, column - 3 : column + 4].reshape(49, 2).astype(float)
        left = window - fit @ np.linalg.lstsq(fit, window, rcond=None)[0]
        assert found[row, column] == pytest.approx(np.square(left).sum() / 49, rel=0.02)
    grey, rough = texture(96, 160), rng.normal(0, 0.1, (96, 160, 2)).astype(np.float32)
    slow, fast = (float(np.median(both_ways(rough + np.float32(speed), grey)[:60, :120])) for speed in (0, 30))
    assert fast > 1.5 * slow


@pytest.mark.parametrize("name", ["alley_walk", "temple_orbit", "mountain_static"])
def test_confident_flow_is_right_to_a_pixel(rendered: Path, name: str) -> None:
    """Where confidence exceeds 0.5, more than nine pixels in ten err by less than 1 px; and many are confident."""
    files = sorted((rendered / "training" / "final" / name).glob("*.png"))[3:7]
    grey = np.stack([cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in files])
    truth = [
        sintel.read_flo(rendered / "training" / "flow" / name / path.with_suffix(".flo").name) for path in files[:-1]
    ]
    flow = estimate_flow(grey, edge_list(4, (1,)), 0, threads=2)
    right, sure = [], []
    for k, true_flow in enumerate(truth):
        confidence = flow_confidence(flow[k, k + 1], flow[k + 1, k], grey[k], grey[k + 1])
        right.append(np.linalg.norm(flow[k, k + 1] - true_flow, axis=-1) < 1)
        sure.append(confidence > 0.5)
    assert np.stack(right)[np.stack(sure)].mean() >= 0.9
    assert np.stack(sure).mean() > 0.5


def test_script_writes_edges_on_the_reduced_grid(tmp_path: Path) -> None:
    """Wider frames are matched at --max-side-px; the metadata tells the scale."""
    folder = write_frames(tmp_path / "clip", count=3, size=(60, 160))
    write_json(tmp_path / "sequence.json", sequence_to_json(check_sequence("clip", folder)))
    options = FlowOptions(offsets=(1,), max_side_px=80)
    flow_stage.main(tmp_path / "sequence.json", tmp_path / "pairs.arrow", tmp_path / "flow.png", options)
    pairs, metadata = read_dense(tmp_path / "pairs.arrow"), read_metadata(tmp_path / "pairs.arrow")
    assert pairs["flow"].shape == (4, 30, 80, 2)
    assert pairs["flow"].dtype == pairs["confidence"].dtype == np.float16
    assert list(zip(pairs["source"], pairs["target"], strict=True)) == [(0, 1), (1, 0), (1, 2), (2, 1)]
    assert (metadata["width"], metadata["height"], metadata["scale"]) == (80, 30, 0.5)


def test_warp_reads_the_target() -> None:
    image = np.arange(12, dtype=np.float32).reshape(3, 4)
    np.testing.assert_array_equal(warp(image, np.full((3, 4, 2), (1, 0), np.float32))[:, :3], image[:, 1:])
