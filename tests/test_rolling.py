"""Flow of frames whose rows are exposed in turn, as if they were exposed at once, and the motion prior from it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import write_frames
from numpy.testing import assert_allclose
from rolled import FOCAL, STRIDE, hand, observe_rolled
from test_motion import flow_pairs

from stages.ba import shutter
from stages.ba.graph import MIN_WEIGHT, FlowGraph
from stages.ba.state import State
from stages.motion import __main__ as motion_stage
from stages.segment.static_world import static_world
from stages.shared import lie
from stages.shared.artifacts import read_dense, write_dense, write_json
from stages.shared.cameras import centred_intrinsics, make_cameras, pixel_grid, projection, read_readout, write_cameras
from stages.shared.flow_pairs import FlowPairs
from stages.shared.rolling import RollingShutter, frame_times, rolling_shutter
from stages.shared.sequences import check_sequence, sequence_to_json
from stages.shared.static_flow import dense_static_flow
from stages.shared.window_kernels import place

SHAKY, READOUT = hand(0.02, 0.03), 0.8
CELLS = slice(None), slice(STRIDE // 2, None, STRIDE), slice(STRIDE // 2, None, STRIDE)


def exposed_in_turn(graph: FlowGraph, depth: np.ndarray, cell_px: int = STRIDE) -> RollingShutter:
    """The true shutter of what `observe_rolled` returns, with depth at cells alone."""
    first, (T, h, w) = cell_px // 2, depth.shape
    cells = 1 / depth[:, first::cell_px, first::cell_px]
    Ks = np.tile(centred_intrinsics(FOCAL * w, w, h), (T, 1, 1))
    return RollingShutter(READOUT, frame_times(T, graph.times_s), SHAKY(np.arange(T)), Ks, cells, cell_px)


def pairs_of(graph: FlowGraph, shape: tuple[int, ...]) -> FlowPairs:
    """The matches of a graph as flow [E, h, w, 2], zero between its pixels."""
    flow, confidence = np.zeros((len(graph.source), *shape, 2), np.float32), np.zeros((len(graph.source), *shape))
    u, v = np.rint(graph.pixels).astype(int).T
    flow[:, v, u], confidence[:, v, u] = graph.matches - graph.pixels, graph.weights
    return flow_pairs(graph.source, graph.target, flow, confidence)


def test_shifts_are_those_that_the_adjustment_takes_out_of_its_matches() -> None:
    graph, depth = observe_rolled(SHAKY, READOUT, noise_px=0.0)
    rolling, pairs = exposed_in_turn(graph, depth), pairs_of(graph, depth.shape[1:])
    state = State(rolling.cam_from_world, rolling.inverse_depth.reshape(graph.T, -1), FOCAL * graph.width)
    expected, sure = shutter.shifts(graph, state, READOUT), graph.weights > MIN_WEIGHT
    for e, (i, j) in enumerate(zip(graph.source, graph.target, strict=True)):
        found = rolling.shifts(i, j, pairs.flow[e])[CELLS[1:]].reshape(-1, 2)
        assert_allclose(found[sure[e]], expected[e][sure[e]], atol=1e-3)


def test_flow_without_the_shutter_is_that_of_a_static_scene_seen_at_once() -> None:
    """The oracle moves every row with the true path; the correction knows only the poses of the frames."""
    graph, depth = observe_rolled(SHAKY, READOUT, noise_px=0.0)
    rolling, pairs = exposed_in_turn(graph, depth), pairs_of(graph, depth.shape[1:])
    corrected, errors = rolling.taken_out(pairs), []
    for e, (i, j) in enumerate(zip(graph.source, graph.target, strict=True)):
        A, b = projection(*((rolling.cam_from_world[k], rolling.Ks[k]) for k in (i, j)))
        static = dense_static_flow(A, b, 1 / depth[i])
        of_both = [np.linalg.norm(flow - static, axis=-1) for flow in (pairs.flow[e], corrected.flow[e])]
        errors.append(np.stack(of_both)[CELLS].reshape(2, -1)[:, graph.weights[e] > MIN_WEIGHT])
    raw, left = np.median(np.concatenate(errors, axis=1), axis=1)
    assert raw > 0.05
    assert left < 0.1 * raw


def test_rows_of_a_frame_are_seen_where_the_shutter_shows_them() -> None:
    """The oracle moves every row with the true path; rows of the target are known but for what depths differ by."""
    graph, depth = observe_rolled(SHAKY, READOUT, noise_px=0.0)
    rolling, pairs = exposed_in_turn(graph, depth), pairs_of(graph, depth.shape[1:])
    lines, errors = rolling.projections(pairs, depth.shape[1]), []
    for e, (A, b, i, j) in enumerate(zip(*lines, graph.source, graph.target, strict=True)):
        at_once = projection(*((rolling.cam_from_world[k], rolling.Ks[k]) for k in (i, j)))
        ways = (dense_static_flow(*of, 1 / depth[i]) for of in (at_once, (A, b)))
        of_both = np.stack([np.linalg.norm(pairs.flow[e] - way, axis=-1) for way in ways])
        errors.append(of_both[CELLS].reshape(2, -1)[:, graph.weights[e] > MIN_WEIGHT])
    raw, left = np.median(np.concatenate(errors, axis=1), axis=1)
    assert raw > 0.05
    assert left < 0.2 * raw


def test_kernels_take_the_projection_of_the_row() -> None:
    graph, depth = observe_rolled(SHAKY, READOUT, noise_px=0.0)
    h = depth.shape[1]
    A, b = exposed_in_turn(graph, depth).projection(0, 1, h)
    way = dense_static_flow(A, b, 1 / depth[0])
    for u, v in ((3, 0), (70, h // 2), (20, h - 1)):
        p = A[v] @ (u, v, 1) + b[v] / depth[0, v, u]
        assert_allclose(place(A[None], b[None], 0, u, v, 1 / depth[0, v, u]), p[:2] / p[2], rtol=1e-9)
        assert_allclose(way[v, u], p[:2] / p[2] - (u, v), atol=1e-3)
    assert np.linalg.norm(A[0] - A[-1]) > 1e-3 * np.linalg.norm(A[0])


@pytest.mark.parametrize("fall_px", [-9.0, 100.0])
def test_shifts_from_files_are_those_of_points_seen_by_cameras_of_rows(fall_px: float, tmp_path: Path) -> None:
    """A camera zooms, a frame is dropped, the grid is half as large; what leaves the frame is in its end row."""
    (h, w), times, seconds = (24, 40), np.array([0, 2 / 3, 2]), [5.0, 5.1, 5.3]
    twist, focals_px, distance = np.array([0.06, 0.1, -0.04, 0.01, -0.015, 0.02]), np.array([60.0, 66, 78]), 4.0
    clip = replace(check_sequence("clip", write_frames(tmp_path / "clip", 3, (2 * h, 2 * w))), times_s=seconds)
    cells = {"frame": np.arange(1, 4), "inverse_depth": np.full((3, h // 2, w // 2), 1 / distance, np.float32)}
    write_dense(tmp_path / "depth.arrow", cells, {"stride_px": 4.0})
    Ks = np.stack([centred_intrinsics(px, 2 * w, 2 * h) for px in focals_px])
    cameras = make_cameras(lie.exp_se3(times[:, None] * twist), Ks, np.arange(1, 4))
    uv, (i, j) = pixel_grid(h, w), (0, 2)
    of_flow = [centred_intrinsics(px / 2, w, h) for px in focals_px]

    def seen(readout: float) -> np.ndarray:
        begins, ends = (readout * (np.clip(v, 0, h - 1) / (h - 1) - 0.5) for v in (uv[..., 1], uv[..., 1] + fall_px))
        moved = lie.exp_se3((times[j] + ends - times[i] - begins)[..., None] * twist)
        rays = np.dstack([(uv - of_flow[i][:2, 2]) / of_flow[i][0, 0], np.ones((h, w))])
        there = np.einsum("hwab,hwb->hwa", moved[..., :3, :3], distance * rays) + moved[..., :3, 3]
        return there[..., :2] / there[..., 2:] * of_flow[j][0, 0]

    rolling = rolling_shutter(clip, cameras, READOUT, tmp_path / "depth.arrow", 0.5)
    found = rolling.shifts(i, j, np.broadcast_to([0, fall_px], (h, w, 2)).astype(np.float32))
    inner = slice(1, -1), slice(1, -1)
    expected = (seen(READOUT) - seen(0))[inner]
    assert np.abs(expected).max() > 0.3
    assert_allclose(found[inner], expected, atol=0.02)  # bilinear over where rows begin to leave the frame


def test_flow_to_anywhere_has_finite_shifts_and_points_behind_the_camera_have_none() -> None:
    graph, depth = observe_rolled(SHAKY, READOUT, T=4)
    rolling, times = exposed_in_turn(graph, depth), frame_times(4, np.array([3.0, 3.1, 3.4, 3.5]))
    flow = np.full((*depth.shape[1:], 2), 6e4, np.float32)
    for forward in (8.0, -8.0):
        path = lie.exp_se3(np.arange(4)[:, None] * np.array([0, 0, forward, 0, 0.1, 0]))
        shifts = RollingShutter(1.0, times, path, rolling.Ks, 1 / depth + 20, 1).shifts(0, 3, flow)
        assert np.isfinite(shifts).all()
        assert shifts.any() == (forward > 0)


def test_a_still_scene_behind_a_rolling_shutter_does_not_move(tmp_path: Path) -> None:
    """The script takes the shutter from the round before, and what is not said to roll as exposed at once."""
    path = hand(0.04, 0.2)
    graph, depth = observe_rolled(path, READOUT, T=6, noise_px=0.0, stride=1)
    T, h, w = depth.shape
    pairs = pairs_of(graph, (h, w))
    clip = write_frames(tmp_path / "clip", T, (h, w))
    write_json(tmp_path / "sequence.json", sequence_to_json(check_sequence("clip", clip)))
    columns = {name: pairs.columns[name].astype(np.float16) for name in ("flow", "confidence")}
    columns |= {"source": pairs.source, "target": pairs.target}
    write_dense(tmp_path / "pairs.arrow", columns, {"width": w, "height": h, "scale": 1.0})
    cells = {"frame": np.arange(1, T + 1), "inverse_depth": (1 / depth)[CELLS].astype(np.float32)}
    write_dense(tmp_path / "depth.arrow", cells, {"stride_px": STRIDE})
    cameras = make_cameras(path(np.arange(T)), centred_intrinsics(FOCAL * w, w, h), np.arange(1, T + 1))

    def moving_share(decision: str) -> float:
        decided = {"rolling_shutter": {"decision": decision, "readout": READOUT}}
        write_cameras(tmp_path / "poses.parquet", cameras, decided)
        assert read_readout(tmp_path / "poses.parquet") == (READOUT if decision == "rolling" else 0)
        inputs, outputs = ("sequence.json", "pairs.arrow"), ("prior.arrow", "motion.png")
        given = [tmp_path / name for name in (*inputs, *outputs)]
        before = tmp_path / "poses.parquet", tmp_path / "depth.arrow"
        motion_stage.main(*given, motion_stage.MotionOptions(), *before)
        return float((read_dense(tmp_path / "prior.arrow")["probability"] > 0.5).mean())

    assert moving_share("global") > 0.04
    assert moving_share("rolling") == 0
    found = read_dense(tmp_path / "prior.arrow")["static_depth"]
    assert np.median(np.abs(found * depth - 1)) < 0.02, "what masks are compared at"
    frames, evidence = check_sequence("clip", clip), read_dense(tmp_path / "prior.arrow")
    files = [tmp_path / name for name in ("prior.arrow", "pairs.arrow", "poses.parquet", "depth.arrow")]
    world = static_world(frames, evidence, *files)
    assert world is not None
    expected = rolling_shutter(frames, cameras, READOUT, tmp_path / "depth.arrow", 1.0).projection(0, 1, h)
    for rows, of in zip(world.projection(0, 1), expected, strict=True):
        assert_allclose(rows, of, rtol=1e-9, atol=1e-9)
    write_cameras(tmp_path / "poses.parquet", cameras)
    at_once = static_world(frames, evidence, *files)
    assert at_once is not None
    assert at_once.projection(0, 1)[0].shape == (3, 3)
