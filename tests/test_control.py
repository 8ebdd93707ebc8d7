"""The motion models of the control stage, their files, and the whole script."""

import json
from dataclasses import replace
from pathlib import Path

import finished_run as clip
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from square_inputs import write_inputs

from stages.control import __main__ as control_stage
from stages.control.options import ControlOptions
from stages.deformation import arap
from stages.deformation.motion_models import Deformation, MLPDeformation, TableDeformation
from stages.deformation.point_files import (
    deformation_from_tensors,
    deformation_tensors,
    load_deformation,
    save_deformation,
    save_points,
)
from stages.shared.artifacts import read_metadata, read_model, read_table, write_dense
from stages.shared.cameras import read_cameras
from stages.shared.cli import run
from stages.shared.images import write_image
from stages.shared.sequences import read_sequence


def models() -> list[Deformation]:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(12, 3, generator=generator)
    log_radii = torch.full((12,), -1.0)
    table = TableDeformation(points, log_radii, torch.tensor([0.0, 0.2, 0.5, 1.0]))
    network = MLPDeformation(points, log_radii, width=16, depth=2, position_frequencies=2, time_frequencies=3)
    with torch.no_grad():
        for parameter in [*table.parameters(), *network.parameters()]:
            parameter += 0.3 * torch.randn(parameter.shape, generator=generator)
    return [table, network]


@pytest.mark.parametrize("model", models(), ids=["table", "mlp"])
def test_a_model_survives_its_files(model: Deformation, tmp_path: Path) -> None:
    save_points(tmp_path / "points.parquet", model, {})
    save_deformation(tmp_path / "deformation.safetensors", model, {"kind": "any"})
    read = load_deformation(tmp_path / "deformation.safetensors", tmp_path / "points.parquet")
    embedded = deformation_from_tensors(deformation_tensors(model))
    times = torch.tensor([0.0, 0.31, 1.0])
    assert read is not None
    for copy in (read, embedded):
        assert type(copy) is type(model)
        for mine, its in zip(model(times), copy(times), strict=True):
            torch.testing.assert_close(mine, its)
        torch.testing.assert_close(copy.log_radii, model.log_radii)
    quats, _ = model(times)
    torch.testing.assert_close(quats.norm(dim=-1), torch.ones(3, 12))
    torch.testing.assert_close(model(times.double())[0], quats)  # times are float64 elsewhere


def test_a_scene_without_motion_has_files_without_points(tmp_path: Path) -> None:
    save_points(tmp_path / "points.parquet", None, {"status": "static"})
    save_deformation(tmp_path / "deformation.safetensors", None, {"status": "static"})
    assert load_deformation(tmp_path / "deformation.safetensors", tmp_path / "points.parquet") is None


def test_the_table_is_exact_at_its_frames_and_smooth_between() -> None:
    times = torch.linspace(0, 1, 9)
    knots = times[[0, 1, 2, 3, 5, 6, 7, 8]]
    model = TableDeformation(torch.randn(5, 3), torch.zeros(5), knots)
    path = torch.sin(3 * times)
    with torch.no_grad():
        model.table[..., 4] = path[[0, 1, 2, 3, 5, 6, 7, 8], None] / model.extent
    _, translations = model(times)
    np.testing.assert_allclose(
        translations[[0, 1, 2, 3, 5, 6, 7, 8], :, 0].detach(),
        path[[0, 1, 2, 3, 5, 6, 7, 8], None].expand(-1, 5),
        atol=1e-6,
    )
    linear_error = abs(path[4] - 0.5 * (path[3] + path[5]))
    assert abs(translations[4, 0, 0].detach() - path[4]) < 0.2 * linear_error


def test_arap_is_zero_for_rigid_motion_and_not_for_stretching() -> None:
    torch.manual_seed(0)
    points = torch.randn(40, 3, dtype=torch.float64)
    graph = arap.arap_graph(points)
    turn = torch.from_numpy(Rotation.from_rotvec([0.4, -1.0, 2.0]).as_matrix())
    rigid = torch.stack([points, points @ turn.T + 3.0])
    assert float(arap.arap_energy(rigid, *graph)) < 1e-20
    assert float(arap.arap_energy(torch.stack([points, 1.5 * points]), *graph)) > 0.01


def run_fit(
    folder: Path, paths: dict[str, Path], needed: bool = True, *more: str
) -> tuple[dict, dict[str, np.ndarray]]:
    scene = folder / "scene.json"
    decision = {"dynamic": {"needed": needed}, "non_rigid": {"arap_weight": 0.05}}
    scene.write_text(json.dumps(decision))
    outputs = {"points": "points.parquet", "deformation": "deformation.safetensors", "figure": "control.png"}
    flags = paths | {"scene": scene} | {flag: folder / name for flag, name in outputs.items()}
    words = [word for flag, path in flags.items() for word in (f"--{flag}", str(path))]
    with pytest.raises(SystemExit) as end:
        run(control_stage.main, [*words, "--steps", "40", *more])
    assert end.value.code == 0
    return read_metadata(folder / "deformation.safetensors"), read_table(folder / "points.parquet")


def test_the_script_finds_the_sliding_square(tmp_path: Path) -> None:
    report, points = run_fit(tmp_path, write_inputs(tmp_path))
    assert report["status"] == "fitted"
    assert report["training_frames"] == [1, 2, 3, 4, 6, 7, 8]
    assert report["median_px"] < 0.3
    assert 0 < len(points["x"]) <= 64
    model = load_deformation(tmp_path / "deformation.safetensors", tmp_path / "points.parquet")
    assert model is not None
    with torch.no_grad():
        _, translations = model(torch.tensor([0.0, 1.0]))
    travelled = (translations[1] - translations[0]).median(dim=0).values
    assert float(travelled[0]) == pytest.approx(clip.SHIFT * (clip.T - 1), rel=0.2)


def test_depth_is_looked_up_where_a_grid_of_broken_pixels_has_it(tmp_path: Path) -> None:
    """Frames 854 pixels wide, matched at 512, have a depth every 6.67 pixels: 6 would shift the far edge by 85."""
    paths = write_inputs(tmp_path)
    ramp = np.tile(-0.02 * (4.5 * np.arange(clip.W // 4) + 1.75), (clip.T, clip.H // 4, 1)).astype(np.float32)
    columns = {"inverse_depth": np.exp(ramp), "variance": (0.01 * np.exp(ramp)) ** 2}
    write_dense(paths["depth"], columns, {"stride_px": 4.5})
    sequence, cameras = read_sequence(paths["sequence"]), read_cameras(paths["poses"])
    seen = control_stage._sightings(sequence, paths["flow"], paths["masks"], paths["depth"], cameras, ControlOptions())
    assert seen.uv[:, 0].max() > 20
    np.testing.assert_allclose(np.log(seen.depth), 0.02 * seen.uv[:, 0], atol=0.01)


def test_masks_that_the_poses_distrust_carry_no_tracks(tmp_path: Path) -> None:
    found = []
    for name, mask in (("full", np.ones((clip.H, clip.W), bool)), ("empty", np.zeros((clip.H, clip.W), bool))):
        paths = write_inputs(tmp_path / name)
        write_image(paths["masks"] / "frame_0002.png", mask)
        cameras = replace(read_cameras(paths["poses"]), masks_trusted=np.arange(clip.T) != 1)
        sequence = read_sequence(paths["sequence"])
        found.append(
            control_stage._sightings(sequence, paths["flow"], paths["masks"], paths["depth"], cameras, ControlOptions())
        )
    np.testing.assert_array_equal(found[0].uv, found[1].uv)


def test_the_whole_scene_can_carry_control_points(tmp_path: Path) -> None:
    dynamic, inside = run_fit(tmp_path / "dynamic", write_inputs(tmp_path / "dynamic"))
    whole, everywhere = run_fit(tmp_path / "whole", write_inputs(tmp_path / "whole"), True, "--region", "whole")
    assert (dynamic["region"], whole["region"]) == ("dynamic", "whole")
    assert np.ptp(everywhere["x"]) > 1.5 * np.ptp(inside["x"])
    assert whole["tracks"] > 2 * dynamic["tracks"]


def test_held_out_frames_move_nothing(tmp_path: Path) -> None:
    for name, poison in (("clean", False), ("poisoned", True)):
        run_fit(tmp_path / name, write_inputs(tmp_path / name, poison=poison))
    clean, poisoned = (read_model(tmp_path / name / "deformation.safetensors") for name in ("clean", "poisoned"))
    assert clean.keys() == poisoned.keys()
    for name, values in clean.items():
        np.testing.assert_array_equal(values, poisoned[name], err_msg=name)


@pytest.mark.parametrize("needed", [True, False])
def test_without_motion_the_script_says_why(tmp_path: Path, needed: bool) -> None:
    report, points = run_fit(tmp_path, write_inputs(tmp_path, motion=False), needed)
    assert len(points["x"]) == 0
    assert report["status"] == ("no dynamic pixel could be tracked" if needed else "the scene has no moving parts")
    assert (tmp_path / "control.png").stat().st_size < 300_000
