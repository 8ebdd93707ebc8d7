"""True flow as input, the start from sparse matches, and the errors that the evaluation reports."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import DATA, write_frames
from synthetic import Scene, exact_flow, make_scene

from stages.evaluate.flow_error import flow_errors, flow_rows
from stages.flow import __main__ as flow_stage
from stages.flow import matches
from stages.flow.dis import solve_pair
from stages.flow.edges import Edge, edge_list
from stages.flow.options import FlowOptions
from stages.flow.true_flow import read_truth, true_flow
from stages.shared import lie, sintel
from stages.shared.artifacts import Dense, read_dense, read_metadata, write_json
from stages.shared.errors import InputError
from stages.shared.images import write_image
from stages.shared.sequences import Sequence, check_sequence, sequence_to_json
from stages.shared.warp import is_inside


def written(scene: Scene, folder: Path, masks: bool = True) -> Sequence:
    """Frames of noise with the exact truth of a scene beside them, as MPI-Sintel lays them out."""
    training = folder / "training"
    write_frames(training / "final" / "room", scene.T, scene.depth.shape[1:])
    for kind in ("camdata_left", "depth", "flow", "motion_mask", "occlusions"):
        (training / kind / "room").mkdir(parents=True)
    for k in range(scene.T):
        name = f"room/frame_{k + 1:04d}"
        sintel.write_cam(training / f"camdata_left/{name}.cam", scene.K, scene.cam_from_world[k, :3])
        sintel.write_dpt(training / f"depth/{name}.dpt", scene.depth[k])
        if masks:
            write_image(training / f"motion_mask/{name}.png", scene.dynamic[k])
        if k + 1 < scene.T:
            flow, visible = exact_flow(scene, k, k + 1)
            sintel.write_flo(training / f"flow/{name}.flo", flow)
            write_image(training / f"occlusions/{name}.png", ~visible)
    return check_sequence("room", training / "final" / "room")


@pytest.mark.parametrize("masks", [True, False])
def test_true_flow_is_exact_for_static_and_moving_pixels_of_every_edge(tmp_path: Path, masks: bool) -> None:
    """Reprojection of the scene is the oracle; composed and inverted flow of movers is as good as 1/32 px allows."""
    scene = make_scene(T=6, size=(96, 144), disc_radius=0.6)
    truth = read_truth(written(scene, tmp_path, masks), 144, 96)
    for edge in edge_list(6, (1, 2, 5)):
        flow, known = true_flow(truth, edge)
        expected, visible = exact_flow(scene, *edge)
        error, moving = np.linalg.norm(flow - expected, axis=-1), scene.dynamic[edge[0]]
        assert error[known & ~moving].max() < (1e-4 if masks else 0.1)
        assert error[known & moving].max(initial=0) < 0.1
        assert (known & ~visible).sum() <= 0.002 * known.size
        assert known[visible & ~moving].mean() > 0.85
        assert known[visible & moving].mean() > 0.6


def test_true_flow_on_a_reduced_grid_keeps_to_one_surface(tmp_path: Path) -> None:
    scene = make_scene(T=3, size=(96, 144))
    truth = read_truth(written(scene, tmp_path), 72, 48)
    flow, known = true_flow(truth, (0, 2))
    expected = cv2.resize(exact_flow(scene, 0, 2)[0].astype(np.float32), (72, 48)) / 2
    assert np.linalg.norm(flow - expected, axis=-1)[known].max() < 0.02
    assert known.mean() > 0.7


def test_missing_truth_is_named(tmp_path: Path) -> None:
    folder = write_frames(tmp_path / "clip")
    write_json(tmp_path / "sequence.json", sequence_to_json(check_sequence("clip", folder)))
    outputs = tmp_path / "pairs.arrow", tmp_path / "flow.png"
    with pytest.raises(InputError, match=r"camdata_left, depth, flow.*source: dis"):
        flow_stage.main(tmp_path / "sequence.json", *outputs, FlowOptions(source="truth"))
    assert not (tmp_path / "pairs.arrow").exists()


def test_evaluation_finds_no_error_in_true_flow_and_a_known_one_in_shifted_flow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flow_stage, "write_figure", lambda *_: None)
    scene = make_scene(T=4, size=(96, 144), disc_radius=0.6)
    frames = written(scene, tmp_path)
    write_json(tmp_path / "sequence.json", sequence_to_json(frames))
    options = FlowOptions(source="truth", offsets=(1,))
    flow_stage.main(tmp_path / "sequence.json", tmp_path / "pairs.arrow", tmp_path / "flow.png", options)
    about = read_metadata(tmp_path / "pairs.arrow")
    assert (about["source"], about["border_px"]) == ("truth", 0)
    pairs = Dense({name: np.array(values) for name, values in read_dense(tmp_path / "pairs.arrow").items()})
    rows = {row["quantity"]: row for row in flow_rows(frames, pairs)}
    assert rows["flow right where confident"]["value"] == 100
    assert rows["flow end-point error, visible"]["value"] < 0.05
    pairs["flow"] = pairs["flow"] + np.float16(2)
    found = flow_errors(frames, pairs)
    assert np.median(found.error_px) == pytest.approx(2 * 2**0.5, abs=0.02)
    assert not found.right().any()
    shifted = {row["quantity"]: row for row in flow_rows(frames, pairs)}
    classes = [row["n"] for name, row in shifted.items() if "motion" in name]
    assert sum(classes) == shifted["flow end-point error"]["n"] == 3 * 96 * 144


def test_a_real_pair_goes_through_the_same_evaluation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Film frames that move by 27 px, one of three pairs with truth: confident flow is right."""
    folder = DATA / "sintel_real" / "training" / "final" / "cave_2_mid"
    if not folder.is_dir():
        pytest.skip(f"no measuring data at {DATA}")
    frames = check_sequence(folder.name, folder)
    write_json(tmp_path / "sequence.json", sequence_to_json(frames))
    monkeypatch.setattr(flow_stage, "write_figure", lambda *_: None)
    options = FlowOptions(offsets=(1,), finest_scale=1)
    flow_stage.main(tmp_path / "sequence.json", tmp_path / "pairs.arrow", tmp_path / "flow.png", options)
    rows = {row["quantity"]: row for row in flow_rows(frames, read_dense(tmp_path / "pairs.arrow"))}
    assert rows["flow right where confident"]["value"] > 90
    assert rows["flow confident"]["value"] > 40
    assert rows["flow end-point error, visible"]["value"] < 3
    assert rows["flow end-point error, motion 40+ px"]["n"] > 50_000


def turned_frames(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Two frames [2, h, w, 3] uint8 that differ by a large turn and zoom of a fine texture, and the true flow."""
    h, w = 218, 320
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((h, w, 3))
    image = sum(cv2.GaussianBlur(noise, (0, 0), s) * s for s in (1.2, 3.0))
    image = cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    A = cv2.getRotationMatrix2D((w / 2, h / 2), 28, 0.85)
    other = cv2.warpAffine(image, A, (w, h), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    v, u = np.mgrid[:h, :w].astype(np.float32)
    flow = np.stack([A[0, 0] * u + A[0, 1] * v + A[0, 2] - u, A[1, 0] * u + A[1, 1] * v + A[1, 2] - v], axis=-1)
    return np.stack([image, other]), flow.astype(np.float32)


def searched(rgb: np.ndarray) -> tuple[np.ndarray, dict[Edge, np.ndarray]]:
    """Grey frames of a pair and plain flow of both edges."""
    grey = np.stack([cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in rgb])
    return grey, {(i, j): solve_pair(grey[i], grey[j], None, 1) for i, j in ((0, 1), (1, 0))}


def test_sparse_matches_rescue_a_pair_that_plain_search_loses() -> None:
    rgb, truth = turned_frames()
    grey, plain = searched(rgb)
    better = matches.restarted_pair(rgb, grey, plain, (0, 1), 1)
    errors = [np.linalg.norm(flow[0, 1] - truth, axis=-1)[40:-40, 60:-60] for flow in (plain, better)]
    assert np.median(errors[0]) > 5
    assert np.median(errors[1]) < 1


def test_sparse_start_is_the_same_in_every_thread_and_call() -> None:
    """OpenCV's interpolators of two threads share state: side by side, one call in three differs."""
    rgb, _ = turned_frames()
    grey, plain = searched(rgb)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    with ThreadPoolExecutor(2) as pool:
        tasks = [pool.submit(matches.restarted_pair, rgb, grey, plain, (0, 1), 1) for _ in range(4)]
        first, *others = (task.result() for task in tasks)
    cv2.setNumThreads(threads)
    assert sorted(first) == sorted(plain)
    assert all(np.array_equal(first[edge], other[edge]) for other in others for edge in plain)


def test_the_gate_leaves_slow_and_textureless_pairs_alone() -> None:
    rgb, _ = turned_frames()
    still = np.stack([rgb[0], rgb[0]])
    assert matches.restarted_pair(still, *searched(still), (0, 1), 1) == {}
    grey = np.full((2, 64, 96), 128, np.uint8)
    assert matches.sparse_matches(*grey).shape == (0, 2, 2)
    assert matches.trusted(np.zeros((10, 2, 2), np.float32)) is None


def test_true_flow_of_points_beside_the_camera_is_finite_in_the_file(tmp_path: Path) -> None:
    """The next camera stands in the wall: true flow of a million pixels is beyond half precision."""
    room = make_scene(T=3, size=(48, 72))
    ahead = lie.from_parts(np.tile(np.eye(3), (3, 1, 1)), np.arange(3)[:, None] * [0.0, 0.0, -1.0])
    scene = replace(room, cam_from_world=ahead, depth=np.full_like(room.depth, 1.00001))
    write_json(tmp_path / "sequence.json", sequence_to_json(written(scene, tmp_path)))
    options = FlowOptions(source="truth", offsets=(1,))
    flow_stage.main(tmp_path / "sequence.json", tmp_path / "pairs.arrow", tmp_path / "flow.png", options)
    pairs = read_dense(tmp_path / "pairs.arrow")
    assert np.isfinite(pairs["flow"]).all()
    far = np.abs(exact_flow(scene, 0, 1)[0]).max(axis=-1) > 72
    assert not is_inside(pairs["flow"][0])[far].any()


def test_true_flow_that_is_no_number_is_named(tmp_path: Path) -> None:
    frames = written(make_scene(T=3, size=(48, 72)), tmp_path)
    flow = sintel.read_flo(path := frames.truth["flow"][2])
    flow[5, 5] = np.nan
    sintel.write_flo(path, flow)
    with pytest.raises(InputError, match=r"frame_0002\.flo: expected finite flow"):
        read_truth(frames, 72, 48)
