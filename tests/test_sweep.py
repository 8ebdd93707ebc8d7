"""Collecting the tables of a sweep and of a scaling from runs whose numbers are known."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import write_frames

from stages.comparisons import scaling, sweep
from stages.comparisons.training_speed import compare_training
from stages.inspect import __main__ as inspect_stage
from stages.inspect.options import PartOptions
from stages.shared.artifacts import read_metadata, write_json, write_model, write_table
from stages.shared.sequences import read_sequence
from stages.shared.tables import read_rows, write_rows

TIMES = {"inspect": 1, "flow": 10, "motion": 2, "segment": 3, "ba": 4, "scene": 5, "control": 6, "gaussians": 20}


def write_scores(folder: Path, ate: float | None, psnr: dict[str, float]) -> None:
    """The evaluation's tables of one run with two rounds."""

    def write(name: str, rows: list[dict[str, Any]]) -> None:
        write_rows(folder / f"{name}.parquet", rows, list(rows[0]), {})

    errors = {"rpe_rot_deg": 0.1, "focal_error_percent": -2.0, "status": "failed" if ate is None else "ok"}
    errors |= {"camera": "moving", "focal": "estimated", "focal_sigma_percent": 1.0, "warnings": 0}
    errors |= {
        "ate": 0.05,
        "rpe_trans": 0.01,
        "path": 9.0,
        "registered": 7,
        "total": 8,
        "note": "",
        "threads": 2,
        "taken": None,
    }
    write("poses", [{"method": m, "ate_percent": a} | errors for m, a in (("ours, round 1", 9.0), ("ours", ate))])
    write("masks", [{"method": "refined masks", "round": r, "iou": r / 10, "boundary_f": r / 20} for r in (2, 1)])
    image = [{"method": "ours", "split": "test", "region": r, "psnr_db": v, "ssim": 0.5} for r, v in psnr.items()]
    write("images", [*image, {"method": "blend", "split": "test", "region": "whole", "psnr_db": 99.0, "ssim": 0.9}])
    rounds = {stage: 2 if stage in ("motion", "segment", "ba") else 1 for stage in TIMES}
    seconds = [s for stage, s in TIMES.items() for _ in range(rounds[stage])]
    stages = [stage for stage in TIMES for _ in range(rounds[stage])]
    times = [
        {"stage": stage, "wall_s": float(s), "cpu_s": 2.0 * s, "peak_mb": 100.0 + s}
        for stage, s in zip([*stages, "colmap", "colmap_masked"], [*seconds, 1000, 1000], strict=True)
    ]
    write("time", times)


def swept(name: str, **changes: Any) -> dict[str, Any]:
    """A run of the listing."""
    about: dict[str, Any] = {"sequence": "a", "group": "presets", "setting": name, "knob": None, "value": None}
    paths = {"scores": f"a/{name}/eval", "model": f"a/{name}/model.safetensors"}
    trainings = {"convergence": f"a/{name}/convergence.parquet", "configured_convergence": "a/one/convergence.parquet"}
    about |= {"stages": {"flow": 1, "ba": 2}, "scene": "a/scene.json", "shared": ["inspect", "flow"]}
    return about | {"overrides": {}, "is_default": False} | paths | trainings | changes


def write_made(folder: Path) -> None:
    """What says how the configured run of a sequence was made: two stages, the second in two rounds."""
    write_json(folder / "sequence.json", {"numbers": list(range(1, 12)), "frames_sha256": "of the frames"})
    for stage in ("flow", "ba"):
        about = {"options": {"seed": 3}, "code": f"code of {stage}", "wall_s": 3.0, "cpu_s": 6.0, "peak_mb": 97.0}
        write_json(folder / f"stats/{stage}.json", about | {"output_mb": 5.0})


def training(step_s: float, steps: int) -> dict[str, np.ndarray]:
    """A training whose PSNR rises by 0.1 dB a step from 10 dB, frames 1 dB above and below it in turn."""
    step = np.arange(1, steps + 1)
    return {"step": step, "psnr": 10 + 0.1 * step + (-1.0) ** step, "seconds": step_s * step}


def test_a_row_says_what_a_setting_reached_and_cost(tmp_path: Path) -> None:
    write_scores(tmp_path / "a/one/eval", 0.5, {"whole": 25.0, "static": 26.0, "dynamic": 20.0})
    write_scores(tmp_path / "a/two/eval", None, {"whole": 24.0})
    for name, step_s, steps in (("one", 0.1, 120), ("two", 0.3, 90)):
        (tmp_path / f"a/{name}/model.safetensors").write_bytes(bytes(2_500_000))
        write_table(tmp_path / f"a/{name}/convergence.parquet", training(step_s, steps))
    write_made(tmp_path / "a")
    yes: dict[str, Any] = {"needed": True}
    decided = {"dynamic": {"needed": False}, "motion_blur": yes, "rotation_only": yes, "sequence": "a"}
    write_json(tmp_path / "a/scene.json", decided | {"atmosphere": yes | {"extinction": 0.0}})
    knob = {"knob": "flow.offsets", "value": [1, 2], "overrides": {"flow.offsets": [1, 2]}, "group": "knobs"}
    write_json(tmp_path / "sweep/runs.json", {"runs": [swept("one", is_default=True), swept("two", **knob)]})
    sweep.main(tmp_path / "sweep/runs.json", tmp_path / "costs.parquet")
    one, two = read_rows(tmp_path / "costs.parquet")
    assert (one["setting"], one["is_default"], two["is_default"], two["value"]) == ("one", True, False, "1,2")
    assert json.loads(two["overrides"]) == {"flow.offsets": [1, 2]}
    assert (one["ate_percent"], one["status"], one["iou"], one["boundary_f"]) == (0.5, "ok", 0.2, 0.1)
    assert (two["ate_percent"], two["status"]) == (None, "failed")
    names = ("camera", "focal", "focal_sigma_percent", "warnings")
    assert [one[name] for name in names] == ["moving", "estimated", 1.0, 0]
    assert (one["registered"], one["total"], one["ate"], one["rpe_trans"]) == (7, 8, 0.05, 0.01)
    assert (one["psnr_db"], one["psnr_static_db"], one["psnr_dynamic_db"], one["ssim"]) == (25.0, 26.0, 20.0, 0.5)
    assert (two["psnr_db"], two["psnr_dynamic_db"]) == (24.0, None)
    # flow once, motion, segment and ba twice; then inspect, scene, control and gaussians. COLMAP is none of ours.
    assert (one["poses_wall_s"], one["wall_s"]) == (10 + 2 * 9, 10 + 2 * 9 + 1 + 5 + 6 + 20)
    assert (one["poses_cpu_s"], one["cpu_s"]) == (2 * one["poses_wall_s"], 2 * one["wall_s"])
    assert one["differing_cpu_s"] == one["cpu_s"] - 2 * (1 + 10)  # inspect and flow are the same for the whole group
    assert one["effects"] == "motion blur"
    assert (one["peak_mb"], one["model_mb"]) == (120.0, 2.5)
    made = {"ran": 2, "options": {"seed": 3}, "code": "code of ba"}
    assert read_metadata(tmp_path / "costs.parquet")["made_under"]["a"]["ba"] == made
    # Run two ends after 90 steps, at a mean of 10 + 0.1 * (41..90) dB; run one is there at that step, 3 times as fast.
    assert two["equal_psnr_db"] == pytest.approx(16.55)
    assert (two["equal_s"], two["configured_equal_s"]) == pytest.approx((27.0, 9.0))
    assert (one["step_ms"], two["step_ms"]) == pytest.approx((100.0, 300.0))


def test_a_training_too_short_to_average_has_no_speed() -> None:
    found = compare_training(training(0.1, 49), training(0.1, 100))
    assert set(found.values()) == {None}


def test_rows_of_growth_add_rounds_up(tmp_path: Path) -> None:
    write_made(tmp_path / "a")
    first = {"wall_s": 1.0, "cpu_s": 2.0, "peak_mb": 99.0, "output_mb": 4.0}
    write_json(tmp_path / "a/round1/stats/ba.json", first)
    stats = {"flow": ["a/stats/flow.json"], "ba": ["a/round1/stats/ba.json", "a/stats/ba.json"]}
    run = {"axis": "frames", "sequence": "a", "stages": {"flow": 1, "ba": 2}, "size": "a/sequence.json", "stats": stats}
    write_json(tmp_path / "scaling/runs.json", {"runs": [run]})
    scaling.main(tmp_path / "scaling/runs.json", tmp_path / "growth.parquet")
    assert read_rows(tmp_path / "growth.parquet") == [
        {"axis": "frames", "n": 11, "stage": "flow", "wall_s": 3.0, "cpu_s": 6.0, "peak_mb": 97.0, "output_mb": 5.0},
        {"axis": "frames", "n": 11, "stage": "ba", "wall_s": 4.0, "cpu_s": 8.0, "peak_mb": 99.0, "output_mb": 9.0},
    ]
    assert list(read_metadata(tmp_path / "growth.parquet")["made_under"]) == ["a"]


@pytest.mark.parametrize(("axis", "size"), [("pixels", 96 * 64), ("gaussians", 7), ("control points", 5)])
def test_sizes_come_from_the_artifacts(tmp_path: Path, axis: str, size: int) -> None:
    write_json(tmp_path / "flow.json", {"options": {"max_side_px": 96}})
    write_json(tmp_path / "sequence.json", {"width": 192, "height": 129})
    write_model(tmp_path / "model.safetensors", {"means": np.zeros((7, 3)), "other": np.zeros(2)})
    write_table(tmp_path / "points.parquet", {"x": np.zeros(5)})
    files = {"pixels": "flow.json", "gaussians": "model.safetensors", "control points": "points.parquet"}
    assert scaling.measure_size(axis, tmp_path / files[axis], tmp_path / "sequence.json") == size


def test_a_limit_of_frames_cuts_the_sequence_and_its_truth(tmp_path: Path) -> None:
    folder = write_frames(tmp_path / "training/final/clip", count=6)
    write_frames(tmp_path / "training/motion_mask/clip", count=6)
    inspect_stage.main(folder, tmp_path / "sequence.json", tmp_path / "figure.png", PartOptions(max_frames=4))
    sequence = read_sequence(tmp_path / "sequence.json")
    assert sequence.numbers == [1, 2, 3, 4]
    assert [path.name for path in sequence.frames] == [f"frame_000{n}.png" for n in (1, 2, 3, 4)]
    assert sorted(sequence.truth["motion_mask"]) == [1, 2, 3, 4]
    inspect_stage.main(folder, tmp_path / "all.json", tmp_path / "figure.png", PartOptions(max_frames=99))
    assert read_sequence(tmp_path / "all.json").numbers == [1, 2, 3, 4, 5, 6]


def test_a_run_about_colmap_is_a_row_per_variant_with_its_seconds(tmp_path: Path) -> None:
    write_scores(tmp_path / "a/both/eval", 0.5, {"whole": 25.0})
    write_made(tmp_path / "a")
    rows = read_rows(tmp_path / "a/both/eval/poses.parquet")
    for row, (name, seconds) in zip(rows, (("COLMAP global", 8.0), ("ours", 3.0)), strict=True):
        row |= {"method": name, "wall_s": seconds, "cpu_s": seconds}
    write_rows(tmp_path / "a/both/eval/poses.parquet", rows, list(rows[0]), {})
    write_json(tmp_path / "sweep/runs.json", {"runs": [swept("both", overrides={"colmap.upsample": [1]})]})
    sweep.main(tmp_path / "sweep/runs.json", tmp_path / "sweep/costs.parquet")
    (row,) = read_rows(tmp_path / "sweep/costs.parquet")
    assert (row["setting"], row["ate_percent"], row["poses_cpu_s"], row["psnr_db"]) == ("COLMAP global", 9.0, 8.0, None)
