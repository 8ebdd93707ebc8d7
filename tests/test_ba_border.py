"""Flow leads too far outwards at the border of the image: what counts there, and what that does to the cameras."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import write_frames
from numpy.testing import assert_allclose
from synthetic import flow_arrays, make_scene, observe

from stages.ba.estimate import estimate
from stages.ba.given import Known
from stages.ba.graph import FlowGraph, build_graph
from stages.ba.options import BAOptions
from stages.ba.problem import Problem
from stages.ba.reading import read_matches
from stages.ba.weights import BORDER_WEIGHT, downweight_border
from stages.flow import __main__ as flow_stage
from stages.flow.options import FlowOptions
from stages.shared.artifacts import read_dense, read_metadata, write_dense, write_json
from stages.shared.images import read_rgb, write_image
from stages.shared.sequences import check_sequence, sequence_to_json

BORDER_PX, SHIFT_PX = 6, 0.1


def shifted(graph: FlowGraph) -> FlowGraph:
    """The graph whose matches within BORDER_PX of the border lead outwards by up to SHIFT_PX more."""
    ends = np.array([graph.width, graph.height]) - 1
    reach = np.clip(1 - graph.pixels / BORDER_PX, 0, 1) - np.clip(1 - (ends - graph.pixels) / BORDER_PX, 0, 1)
    return replace(graph, matches=(graph.matches - SHIFT_PX * reach).astype(np.float32))


@pytest.mark.parametrize("aspect", [1.0, 2.0])
def test_pixels_at_the_border_count_little(aspect: float) -> None:
    source, target, flow, confidence = flow_arrays(make_scene(T=3))
    graph = build_graph(source, target, flow, confidence, 3, 1, aspect=aspect, border_px=3)
    v, u = np.indices((64, 96)).reshape(2, -1)
    inner = (u >= 3) & (u <= 92) & (v >= 3) & (v <= 60)
    assert 0 < inner.sum() < len(inner)
    expected = graph.weights * np.where(inner, 1, BORDER_WEIGHT)
    assert_allclose(downweight_border(graph).weights, expected, rtol=1e-6)
    assert downweight_border(graph).weights.dtype == np.float32


@pytest.mark.parametrize("size", [(64, 96), (96, 64)])
def test_a_border_takes_no_more_than_its_share_of_the_shorter_side(size: tuple[int, int]) -> None:
    graph = replace(observe(make_scene(T=3, size=size), stride=1), border_px=16)
    graph = replace(graph, weights=np.ones_like(graph.weights))
    faint = (downweight_border(graph).weights < 1)[0].reshape(size)
    assert not faint[4:-4, 4:-4].any()
    assert faint.sum() == faint.size - (size[0] - 8) * (size[1] - 8)


def test_flow_that_leads_outwards_at_the_border_makes_no_longer_lens_where_cameras_turn() -> None:
    scene = make_scene(T=8, size=(96, 160), motion="rotate")
    graph = shifted(observe(scene))
    without, counted = (
        estimate(Problem(replace(graph, border_px=width), masked=True), BAOptions()).state.focal_px / scene.focal_px - 1
        for width in (BORDER_PX, 0)
    )
    assert abs(without) < 0.5 * counted
    assert counted > 3e-4


@pytest.mark.parametrize(("scale", "width"), [(0, 8), (1, 16)])
def test_the_flow_states_its_border_and_the_adjustment_reads_it(tmp_path: Path, scale: int, width: int) -> None:
    folder = write_frames(tmp_path / "clip", count=3, size=(64, 96))
    for path in folder.iterdir():  # without the noise of these frames, which is matched on a coarser level
        write_image(path, cv2.GaussianBlur(read_rgb(path), (0, 0), 2))
    write_json(tmp_path / "sequence.json", sequence_to_json(check_sequence("clip", folder)))
    flow = tmp_path / "pairs.arrow"
    flow_stage.main(tmp_path / "sequence.json", flow, tmp_path / "flow.png", FlowOptions(finest_scale=scale))
    matches = read_matches(flow, 3, BAOptions())
    assert matches.graph(4, Known(None, 1.0)).border_px == width
    (columns, about), stated = (read_dense(flow), read_metadata(flow)), tmp_path / "stated.arrow"
    write_dense(stated, columns, {key: value for key, value in about.items() if key in ("width", "height", "scale")})
    assert read_matches(stated, 3, BAOptions()).border_px == 0, "flow of another source"
