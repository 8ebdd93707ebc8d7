"""Grids of bundle adjustment: which pixels of the flow a cell stands for where the stride does not divide the size."""

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from synthetic import make_scene, observe

from stages.ba.dba import normalise
from stages.ba.depth import depth_maps
from stages.ba.given import Known
from stages.ba.graph import FlowGraph, build_graph
from stages.ba.reading import Matches
from stages.ba.state import State
from stages.ba.weights import mask_graph
from stages.shared.artifacts import read_dense, write_dense
from stages.shared.packing import Packed, pack

SIZE = 220, 100
"""4 divides this height, 8 does not: two grids of cells that cover different areas."""


def empty_graph(stride: int) -> FlowGraph:
    """Two frames of SIZE without motion."""
    flow, confidence = np.zeros((2, *SIZE, 2), np.float32), np.ones((2, *SIZE), np.float32)
    return build_graph(np.array([0, 1]), np.array([1, 0]), flow, confidence, 2, stride)


@pytest.mark.parametrize(("source", "target"), [(4, 8), (8, 4), (1, 8), (3, 8)])
def test_maps_are_resampled_where_their_cells_lie(source: int, target: int) -> None:
    coarse, graph = empty_graph(source), empty_graph(target)
    ramp = (3 * coarse.pixels[:, 1] - coarse.pixels[:, 0]).reshape(1, coarse.rows, coarse.columns)
    low, high = coarse.pixels.min(axis=0), coarse.pixels.max(axis=0)
    inside = ((graph.pixels >= low) & (graph.pixels <= high)).all(axis=1)
    assert inside.mean() > 0.8
    expected = 3 * graph.pixels[:, 1] - graph.pixels[:, 0]
    # OpenCV looks up to 1/32 of a cell beside the place.
    assert_allclose(graph.resample(ramp, source)[0, inside], expected[inside], atol=4 / 32 * source)


def test_pixels_that_are_not_square_are_looked_up_where_they_lie() -> None:
    """fy = 2 fx: the graph counts rows by halves, maps and masks of the flow grid do not."""
    flow, confidence = np.full((2, *SIZE, 2), 3, np.float32), np.ones((2, *SIZE), np.float32)
    square = empty_graph(8)
    graph = build_graph(np.array([0, 1]), np.array([1, 0]), flow, confidence, 2, 8, np.array([70.0, 44.0]), 2.0)
    assert_allclose(graph.pixels, square.pixels * [1, 0.5])
    assert_allclose(graph.matches[0], (square.pixels + 3) * [1, 0.5])
    assert_allclose(graph.centre, [70, 22])
    ramp = np.tile(np.arange(SIZE[0], dtype=np.float32)[:, None], (2, 1, SIZE[1]))
    assert_allclose(graph.resample(ramp, 1)[0], square.pixels[:, 1], atol=1 / 16)
    static = np.ones((2, *SIZE), np.float32)
    static[1, 120:] = 0
    kept = mask_graph(graph, static).weights[0] > 0.5
    assert_array_equal(kept, square.pixels[:, 1] + 3 < 119.5)


def test_areas_of_cells_are_those_that_they_were_sampled_from() -> None:
    graph = empty_graph(8)
    values = np.arange(len(graph.pixels)).reshape(1, graph.rows, graph.columns)
    spread = graph.spread(values)
    assert spread.shape == (1, *SIZE)
    u, v = np.rint(graph.pixels).astype(int).T
    assert_array_equal(spread[0, v, u], values.ravel())
    assert_array_equal(spread[0, 216:], spread[0, 212:216])


def test_a_match_counts_where_both_of_its_ends_are_static() -> None:
    flow, confidence = np.zeros((2, 32, 48, 2), np.float32), np.ones((2, 32, 48), np.float32)
    flow[0, ..., 0], flow[1, ..., 0] = 16, -16
    graph = build_graph(np.array([0, 1]), np.array([1, 0]), flow, confidence, 2, 8)
    static = np.ones((2, 32, 48), np.float32)
    static[1, :, 16:24] = 0  # the third column of cells of the second frame, where the first column comes to lie
    weights = mask_graph(graph, static).weights.reshape(2, 4, 6)
    assert_array_equal(weights[0], np.broadcast_to([0, 1, 1, 1, 1, 1], (4, 6)))
    assert_array_equal(weights[1], np.broadcast_to([1, 1, 0, 1, 1, 1], (4, 6)))


def test_depth_is_filled_in_the_masked_cells_alone() -> None:
    scene = make_scene(T=4, size=(62, 96))
    graph = observe(scene, stride=8)
    state = normalise(State(scene.cam_from_world, graph.resample(1 / scene.depth, 1), scene.focal_px))
    static = np.ones((4, 62, 96), np.float32)
    static[:, 48:] = 0
    filled = depth_maps(replace(graph, weights=np.ones_like(graph.weights)), graph, state, static, True).filled
    assert filled[:, 6].all()
    assert not filled[:, :6].any()


def test_packed_flow_is_read_edge_by_edge(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of all edges, and of those of some frames; a slice of the packed rows would unpack them together."""
    monkeypatch.setattr("stages.shared.rows.SHORT_BYTES", 0)  # of a long clip
    T, shape, rng = 150, (64, 96), np.random.default_rng(0)
    source, target = np.arange(T), (np.arange(T) + 1) % T
    flow = rng.normal(size=(T, *shape, 2)).astype(np.float16)
    confidence = rng.uniform(0, 1, (T, *shape)).astype(np.float16)
    packed = {
        "flow": Packed(list(map(pack, flow)), flow.shape[1:]),
        "confidence": Packed(list(map(pack, confidence)), shape),
    }
    write_dense(tmp_path / "pairs.arrow", {"source": source, "target": target, **packed})
    known = Known(np.array([47.5, 31.5]), 1.0)
    for frames in (None, (40, 130)):
        part = slice(*(frames or (0, T)))
        expected = build_graph(source[part], target[part], flow[part], confidence[part], T, 8, known.centre)
        matches = Matches(read_dense(tmp_path / "pairs.arrow"), np.ones(T, bool), (96, 64), 1.0)
        tracemalloc.start()
        found = matches.graph(8, known, frames)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        for name in ("source", "target", "pointer", "matches", "weights"):
            assert_array_equal(getattr(found, name), getattr(expected, name))
        assert peak < flow[part].nbytes / 1.2
