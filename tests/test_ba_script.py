"""The pose script: every artifact, a second round, and refusals."""

import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from ba_files import outputs, write_inputs
from numpy.testing import assert_allclose
from synthetic import flow_arrays, make_scene, trajectory_error

from stages.ba import cuts
from stages.ba.__main__ import main
from stages.ba.options import BAOptions
from stages.ba.problem import Estimate, Problem
from stages.ba.uncertainty import CORRELATION
from stages.flow.__main__ import main as estimate_flow
from stages.flow.options import FlowOptions
from stages.shared.artifacts import read_dense, read_metadata, read_table, write_json
from stages.shared.cameras import read_cameras, write_cameras
from stages.shared.errors import InputError
from stages.shared.images import write_image
from stages.shared.sequences import check_sequence, sequence_to_json
from stages.shared.sintel import read_cams


@pytest.fixture
def artifacts(tmp_path: Path) -> dict[str, Path]:
    """Input files of the script for a small exact scene with a mover."""
    scene = make_scene(T=6, size=(64, 96), disc_radius=0.6)
    return write_inputs(tmp_path, flow_arrays(scene), scene.dynamic)


def test_the_script_writes_every_artifact_and_continues_a_round(artifacts: dict[str, Path], tmp_path: Path) -> None:
    options = BAOptions(stride_px=4, depth_stride_px=2)
    first, second = outputs(tmp_path / "one"), outputs(tmp_path / "two")
    main(**artifacts, **first, options=options)
    main(**artifacts, **second, options=options, previous_poses=first["poses"])
    scene = make_scene(T=6, size=(64, 96), disc_radius=0.6)
    for paths in (first, second):
        cameras = read_cameras(paths["poses"])
        assert trajectory_error(cameras.cam_from_world, scene.cam_from_world) < 5e-3
        assert list(cameras.status) == ["estimated"] * 6
        assert (np.linalg.eigvalsh(cameras.covariance[1:]) > 0).all()
        assert len(paths["trajectory"].read_text().splitlines()) == 6
        depth = read_dense(paths["depth"])
        assert depth["inverse_depth"].shape == (6, 32, 48)
        assert read_metadata(paths["depth"])["stride_px"] == 2
        assert set(read_table(paths["convergence"])) > {"iteration", "cost", "damping", "seconds"}
        assert cv2.imread(str(paths["figure"])).shape[1] == 1200
    metadata = read_metadata(second["poses"])
    assert metadata["focal"]["decision"] in ("estimated", "weakly observed")
    assert metadata["camera"] == "moving"
    assert metadata["covariance_std_factor"] == CORRELATION > 1


def test_a_mover_has_one_depth_in_a_frame_and_it_changes_as_the_mover_grows(tmp_path: Path) -> None:
    scene = make_scene(T=6, size=(64, 96), disc_radius=0.6, velocity=(0.05, 0.0, 0.25))
    files, paths = write_inputs(tmp_path, flow_arrays(scene), scene.dynamic), outputs(tmp_path / "out")
    main(**files, **paths, options=BAOptions(stride_px=4, depth_stride_px=2))
    inverse_depth = read_dense(paths["depth"])["inverse_depth"]
    inner = [cv2.erode(mask[1::2, 1::2].astype(np.uint8), np.ones((3, 3))) > 0 for mask in scene.dynamic]
    found = [frame[mask] for frame, mask in zip(inverse_depth, inner, strict=True)]
    true = [1 / np.median(depth[1::2, 1::2][mask]) for depth, mask in zip(scene.depth, inner, strict=True)]
    assert all(np.ptp(values) == 0 for values in found)
    ratios = np.log([values[0] for values in found]) - np.log(true)
    assert np.ptp(np.log(true)) > 0.2
    assert np.ptp(ratios) < 0.03


def test_a_round_is_held_against_the_one_before(artifacts: dict[str, Path], tmp_path: Path) -> None:
    options, (first, second) = BAOptions(stride_px=4), (outputs(tmp_path / name) for name in ("one", "two"))
    main(**artifacts, **first, options=options)
    cameras, metadata = read_cameras(first["poses"]), read_metadata(first["poses"])
    longer = metadata["focal"] | {"focal_px": 1.3 * metadata["focal"]["focal_px"]}
    write_cameras(before := tmp_path / "before.parquet", cameras, {"focal": longer, "static_share": 2.0})
    main(**artifacts, **second, options=options, previous_poses=before)
    flags = read_metadata(second["poses"])["flags"]
    assert any("static area shrank from 2.00" in flag for flag in flags)
    assert any("moved by -23 %" in flag and "not converged" in flag for flag in flags)
    assert "previous round" in read_table(second["convergence"])["phase"]
    assert metadata["flags"] == []


def test_results_are_carried_over_only_where_the_static_area_is_the_same(
    artifacts: dict[str, Path], tmp_path: Path
) -> None:
    options, (one, two, three) = BAOptions(stride_px=4), (outputs(tmp_path / name) for name in ("one", "two", "three"))
    main(**artifacts, **one, options=options)
    before = {f"previous_{name}": one[name] for name in ("poses", "depth", "convergence", "figure")}
    shutil.copytree(artifacts["masks"], masks := tmp_path / "masks before")
    said = main(**artifacts, **two, options=options, **before, previous_masks=masks)
    assert "focal length" in said, "a first round is not settled"
    flags = ["carried", "static area shrank from 1.00 to 0.60 since the round before"]
    assert read_metadata(two["poses"])["from_previous_round"]
    write_cameras(two["poses"], read_cameras(two["poses"]), read_metadata(two["poses"]) | {"flags": flags})
    before = {f"previous_{name}": two[name] for name in ("poses", "depth", "convergence", "figure")}
    assert "unchanged" in main(**artifacts, **three, options=options, **before, previous_masks=masks)
    for name in ("depth", "convergence", "figure"):
        assert three[name].read_bytes() == two[name].read_bytes()
    first, second = (read_table(paths["poses"]) for paths in (two, three))
    for name, column in first.items():
        np.testing.assert_array_equal(second[name], column)
    assert read_metadata(three["poses"]) == read_metadata(two["poses"]) | {"flags": ["carried"]}
    assert_allclose(np.loadtxt(three["trajectory"]), np.loadtxt(two["trajectory"]), atol=1e-12)
    with pytest.raises(InputError, match="give all or none"):
        main(**artifacts, **(four := outputs(tmp_path / "four")), options=options, previous_masks=masks)
    assert not any(path.exists() for path in four.values())
    for k in (1, 2):
        write_image(masks / f"frame_{k:04d}.png", np.zeros((64, 96), bool))
    assert "focal length" in main(**artifacts, **three, options=options, **before, previous_masks=masks)
    assert "carried" not in read_metadata(three["poses"])["flags"]


@pytest.mark.parametrize(("wrong", "trusted"), [([], range(6)), ([2, 4], [0, 1, 3, 5]), (range(6), [])])
def test_it_is_said_of_which_frames_the_masks_are_not_believed(
    artifacts: dict[str, Path], tmp_path: Path, wrong: list[int], trusted: list[int]
) -> None:
    for k in wrong:
        write_image(artifacts["masks"] / f"frame_{k + 1:04d}.png", np.ones((64, 96), bool))
    main(**artifacts, **(paths := outputs(tmp_path / "out")), options=BAOptions(stride_px=4))
    assert np.flatnonzero(read_cameras(paths["poses"]).masks_trusted).tolist() == list(trusted)


@pytest.mark.parametrize(
    ("motion", "status", "warned"),
    [
        ("rotate", "rotation-only", []),
        ("still", "near-still", ["focal length held at prior", "camera path weakly observed"]),
    ],
)
def test_a_camera_that_hardly_moves_is_labelled_so(motion: str, status: str, warned: list[str], tmp_path: Path) -> None:
    scene = make_scene(T=6, motion=motion)
    files, paths = write_inputs(tmp_path, flow_arrays(scene), scene.dynamic), outputs(tmp_path / "out")
    main(**files, **paths, options=BAOptions(stride_px=4))
    assert list(read_cameras(paths["poses"]).status) == [status] * 6
    assert [flag.split(":")[0] for flag in read_metadata(paths["poses"])["flags"]] == warned


def test_flow_counts_less_where_the_frames_have_no_texture(tmp_path: Path) -> None:
    """The same flow, which loses a tenth of its expansion on the right, as it does on a flat wall."""
    scene, errors = make_scene(T=6), []
    source, target, flow, confidence = flow_arrays(scene)
    right = flow[:, :, 64:]
    right -= 0.1 * (right - right.mean(axis=(1, 2), keepdims=True))
    for flat in (False, True):
        folder = tmp_path / f"flat_{flat}"
        files = write_inputs(folder, (source, target, flow, confidence), scene.dynamic)
        frame = np.random.default_rng(0).integers(0, 255, (64, 96, 3)).astype(np.uint8)
        frame[:, 64:] = 128 if flat else frame[:, 64:]
        for path in (folder / "clip").iterdir():
            write_image(path, frame)
        main(**files, **(paths := outputs(folder)), options=BAOptions(stride_px=4))
        errors.append(abs(read_cameras(paths["poses"]).Ks[0, 0, 0] / scene.focal_px - 1))
    assert errors[1] < 0.5 * errors[0]


def test_what_is_no_number_is_null_in_the_metadata(tmp_path: Path) -> None:
    source, target, flow, confidence = flow_arrays(make_scene(T=4, size=(48, 64)))
    files = write_inputs(tmp_path, (source, target, flow, 0 * confidence), np.zeros((4, 48, 64), bool))
    main(**files, **(paths := outputs(tmp_path / "out")), options=BAOptions(stride_px=4))
    assert read_metadata(paths["poses"])["residual_px"] is None
    assert b"Infinity" not in paths["poses"].read_bytes()


def test_a_missing_mask_is_named(artifacts: dict[str, Path], tmp_path: Path) -> None:
    (artifacts["masks"] / "frame_0003.png").unlink()
    with pytest.raises(InputError, match=r"frame_0003\.png"):
        main(**artifacts, **outputs(tmp_path / "out"), options=BAOptions())


def test_true_intrinsics_without_truth_are_refused(artifacts: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="intrinsics"):
        main(**artifacts, **outputs(tmp_path / "out"), options=BAOptions(intrinsics="truth"))


def test_true_intrinsics_are_those_of_the_camera_files(rendered: Path, tmp_path: Path) -> None:
    training = tmp_path / "training"
    for kind in ("final", "camdata_left"):
        (training / kind / "mountain_static").mkdir(parents=True)
        for path in sorted((rendered / "training" / kind / "mountain_static").iterdir())[:6]:
            shutil.copy(path, training / kind / "mountain_static" / path.name)
    frames = check_sequence("mountain_static", training / "final" / "mountain_static")
    write_json(sequence := tmp_path / "sequence.json", sequence_to_json(frames))
    options = FlowOptions(offsets=(1, 2), max_side_px=256)
    estimate_flow(sequence, flow := tmp_path / "pairs.arrow", tmp_path / "flow.png", options)
    for number in frames.numbers:
        write_image(tmp_path / "masks" / f"frame_{number:04d}.png", np.zeros((frames.height, frames.width), bool))
    paths = outputs(tmp_path / "out")
    main(sequence, flow, masks=tmp_path / "masks", **paths, options=BAOptions(intrinsics="truth"))
    true_Ks, true_poses = read_cams(frames.truth_files("camdata_left"))
    cameras = read_cameras(paths["poses"])
    assert read_metadata(paths["poses"])["focal"]["decision"] == "known"
    assert_allclose(cameras.Ks, true_Ks, rtol=1e-6)
    assert trajectory_error(cameras.cam_from_world, true_poses) < 5e-3


def test_options_stay_light() -> None:
    import subprocess

    code = "import sys, stages.ba.options; assert not {'numba', 'cv2', 'scipy', 'torch'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_first_round_may_do_without_masks(artifacts: dict[str, Path], tmp_path: Path) -> None:
    masks = artifacts.pop("masks")
    main(**artifacts, **(without := outputs(tmp_path / "without")), options=BAOptions())
    main(**artifacts, **(masked := outputs(tmp_path / "masked")), options=BAOptions(), masks=masks)
    assert read_metadata(without["poses"])["static_share"] == 1 > read_metadata(masked["poses"])["static_share"]
    scene = make_scene(T=6, size=(64, 96), disc_radius=0.6)
    assert trajectory_error(read_cameras(without["poses"]).cam_from_world, scene.cam_from_world) < 0.02


def test_depths_are_bounded_only_where_movers_are_masked(
    artifacts: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A mover may lead beyond infinity, and would draw the cameras along. Empty masks may say that nothing moves."""
    told: list[tuple[bool, bool | None]] = []

    def listen(problem: Problem, *others: object) -> Estimate:
        told.append((problem.graph.masked, problem.unmasked and problem.unmasked.masked))
        return estimate_shot(problem, *others)  # type: ignore[arg-type]

    estimate_shot = cuts.estimate_shot
    monkeypatch.setattr(cuts, "estimate_shot", listen)
    masks, options = artifacts.pop("masks"), BAOptions(stride_px=8)
    main(**artifacts, **(first := outputs(tmp_path / "one")), options=options)
    main(**artifacts, **outputs(tmp_path / "two"), options=options, previous_poses=first["poses"])
    main(**artifacts, **outputs(tmp_path / "three"), options=options, masks=masks)
    for path in masks.glob("*.png"):
        write_image(path, np.zeros((64, 96), bool))
    main(**artifacts, **outputs(tmp_path / "four"), options=options, masks=masks)
    write_json(masks / "masks.json", {"options": {"source": "none"}})
    main(**artifacts, **outputs(tmp_path / "five"), options=options, masks=masks)
    assert told == [(False, None), (False, None), (True, False), (True, None), (False, None)]
