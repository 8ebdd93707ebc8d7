"""Hard sizes of frames: 854 x 480 px reduced to 512 px wide make 287.8 rows."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from ba_files import outputs
from numpy.testing import assert_allclose

from stages.ba.__main__ import main as solve
from stages.ba.options import BAOptions
from stages.evaluate.flow_error import flow_errors
from stages.flow.__main__ import main as estimate_flow
from stages.flow.options import FlowOptions
from stages.segment.refinement import smooth_along_edges
from stages.shared import sintel
from stages.shared.artifacts import Dense, read_dense, read_metadata, write_json
from stages.shared.cameras import read_cameras
from stages.shared.images import read_reduced, write_image
from stages.shared.sequences import Sequence, check_sequence, sequence_to_json

H, W = 480, 854
SCALE = 512 / W
DOT_PX = (430.0, 468.0)
"""A dot near the lower edge."""


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    """Three frames with a blurred dot."""
    folder = tmp_path_factory.mktemp("size") / "clip"
    v, u = np.mgrid[:H, :W]
    dot = 255 * np.exp(-((u - DOT_PX[0]) ** 2 + (v - DOT_PX[1]) ** 2) / (2 * 2.5**2))
    for number in (1, 2, 3):
        write_image(folder / f"frame_{number:04d}.png", np.repeat(np.rint(dot).astype(np.uint8)[..., None], 3, axis=2))
    return check_sequence("clip", folder)


@pytest.fixture(scope="module")
def flow(frames: Sequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The flow between them."""
    folder = tmp_path_factory.mktemp("flow")
    write_json(folder / "sequence.json", sequence_to_json(frames))
    estimate_flow(folder / "sequence.json", folder / "pairs.arrow", folder / "flow.png", FlowOptions(offsets=(1,)))
    return folder / "pairs.arrow"


def full_rows(h: int) -> np.ndarray:
    """Rows of the whole frame that the rows of the grid stand for, [h]."""
    return (np.arange(h) + 0.5) / SCALE - 0.5


def test_a_dot_at_the_lower_edge_lies_where_the_scale_says(frames: Sequence, flow: Path) -> None:
    about = read_metadata(flow)
    assert about["scale"] == SCALE
    image = read_reduced(frames.frames[:1], (about["width"], about["height"]))[0, ..., 0].astype(float)
    v, u = np.mgrid[: about["height"], : about["width"]]
    centre = np.array([(image * u).sum(), (image * v).sum()]) / image.sum()
    assert_allclose((centre + 0.5) / SCALE - 0.5, DOT_PX, atol=0.02)


def test_the_principal_point_is_the_centre_of_the_frame(flow: Path, tmp_path: Path) -> None:
    paths = outputs(tmp_path)
    solve(flow.with_name("sequence.json"), flow, **paths, options=BAOptions())
    assert_allclose(read_cameras(paths["poses"]).Ks[:, :2, 2], [[(W - 1) / 2, (H - 1) / 2]] * 3, atol=1e-9)


def test_a_prior_comes_back_to_the_rows_that_it_stands_for(flow: Path) -> None:
    h, w = read_dense(flow)["confidence"].shape[1:]
    ramp = np.repeat(full_rows(h)[:, None] / H, w, axis=1)
    spread = smooth_along_edges(ramp, np.zeros((H, W, 3), np.uint8), 0.0, 3.0)
    assert_allclose(H * spread[1:477, 400], np.arange(1, 477), atol=0.02)


def test_flow_is_held_against_the_truth_of_its_own_rows(flow: Path, tmp_path: Path) -> None:
    h, w = read_dense(flow)["confidence"].shape[1:]
    true = np.zeros((H, W, 2), np.float32)
    true[..., 0] = np.arange(H)[:, None]
    sintel.write_flo(tmp_path / "frame_0001.flo", true)
    truth = {"flow": {1: tmp_path / "frame_0001.flo"}}
    sequence = Sequence("clip", [Path("1.png"), Path("2.png")], [1, 2], W, H, truth)
    field = np.zeros((1, h, w, 2), np.float32)
    field[0, ..., 0] = SCALE * full_rows(h)[:, None]
    pairs = {"source": np.array([0]), "target": np.array([1]), "flow": field, "confidence": np.ones((1, h, w))}
    errors_px = flow_errors(sequence, Dense(pairs)).error_px.reshape(H, W)
    assert errors_px[1:477].max() < 0.02


def test_true_flow_is_that_of_its_own_rows(tmp_path: Path) -> None:
    """Everything moves, by a flow that grows from row to row."""
    true = np.zeros((H, W, 2), np.float32)
    true[..., 0] = 0.05 * np.arange(H)[:, None]
    training = tmp_path / "training"
    clip = training / "final" / "clip"
    for number in (1, 2, 3):
        name = f"frame_{number:04d}"
        write_image(clip / f"{name}.png", np.zeros((H, W, 3), np.uint8))
        for kind in ("motion_mask", "flow", "depth", "camdata_left"):
            (training / kind / "clip").mkdir(parents=True, exist_ok=True)
        write_image(training / "motion_mask" / "clip" / f"{name}.png", np.ones((H, W), bool))
        sintel.write_flo(training / "flow" / "clip" / f"{name}.flo", true)
        sintel.write_dpt(training / "depth" / "clip" / f"{name}.dpt", np.ones((H, W)))
        sintel.write_cam(training / "camdata_left" / "clip" / f"{name}.cam", np.diag([800.0, 800, 1]), np.eye(3, 4))
    write_json(tmp_path / "sequence.json", sequence_to_json(check_sequence("clip", clip)))
    options = FlowOptions(source="truth", offsets=(1,))
    estimate_flow(tmp_path / "sequence.json", tmp_path / "pairs.arrow", tmp_path / "flow.png", options)
    pairs = read_dense(tmp_path / "pairs.arrow")
    first = int(np.flatnonzero((pairs["source"] == 0) & (pairs["target"] == 1))[0])
    h = pairs["flow"].shape[1]
    expected = SCALE * 0.05 * full_rows(h)
    rows = cv2.blur(pairs["flow"][first, :, 100:101, 0].astype(np.float32), (1, 9))[:, 0]  # half precision steps
    assert np.abs(rows - expected)[5:-5].max() < 0.05 * 0.1
