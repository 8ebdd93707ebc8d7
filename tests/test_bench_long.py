"""The benchmark of long video: what its samples hold, what its table decides, and which clip it takes."""

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from benchmarks import bench_long
from benchmarks.resident import held_mb, watched
from stages.comparisons import growth, tradeoff_charts
from stages.configuration import settings
from stages.shared.artifacts import read_json, write_json
from stages.shared.errors import InputError
from stages.shared.images import read_rgb, write_image

HOLDS_40_READS_60_MB = """
import mmap, sys, tempfile
held = bytearray(b"x") * 40_000_000
with open("frames.arrow", "rb") as file:
    mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
with tempfile.TemporaryFile(dir=".") as file:
    file.write(bytes(5_000_000))
    file.flush()
    nameless = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
sum(mapped[k] for k in range(0, len(mapped), 4096))
print(flush=True)
sys.stdin.readline()
"""


def test_a_stage_holds_its_memory_and_what_it_hides_on_the_disk(tmp_path: Path) -> None:
    """Pages of mapped files are not its memory; finished files and what lies elsewhere are not held."""
    (tmp_path / "frames.arrow").write_bytes(bytes(60_000_000))
    for name, size in (("flow/.pairs.arrow.parts/near", 3), ("flow/pairs.arrow", 8), ("ba/.poses.checkpoint/0", 8)):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(bytes(size * 1_000_000))
    flags = ["--output", "flow/pairs.arrow", "--stats", "stats/flow.json"]
    command = [sys.executable, "-c", HOLDS_40_READS_60_MB, *flags]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, cwd=tmp_path, **pipes) as stage:
        assert stage.stdout
        stage.stdout.readline()
        with watched(tmp_path, tmp_path / "resident.json"):
            found = held_mb(tmp_path)
        elsewhere = held_mb(tmp_path.parent)
        stage.communicate(b"\n")
    assert list(found) == ["stats/flow.json"]
    assert 40 <= found["stats/flow.json"]["resident_mb"] < 70
    assert found["stats/flow.json"]["meanwhile_mb"] == pytest.approx(3 + 5, rel=0.01)
    assert not elsewhere
    assert read_json(tmp_path / "resident.json")["stats/flow.json"] == pytest.approx(found["stats/flow.json"], rel=0.01)


def row(n: int, stage: str, cpu_s: float, resident_mb: float | None) -> dict[str, Any]:
    same = {"wall_s": cpu_s / 2, "peak_mb": 900.0, "output_mb": 2.0 * n, "meanwhile_mb": 1.0}
    return {"axis": "frames", "n": n, "stage": stage, "cpu_s": cpu_s, "resident_mb": resident_mb, **same}


def rows() -> list[dict[str, Any]]:
    """Stages that grow with the power 1 and 1.5 of the frames, one of them beyond the memory, one not sampled."""
    sizes = (50, 200, 1000)
    return [
        *(row(n, "flow", 3 + 0.5 * n, 2.0 * n) for n in sizes),
        *(row(n, "ba", 3 + 0.01 * n**1.5, 7.0 * n) for n in sizes),
        *(row(n, "scene", 9.0, None) for n in sizes),
    ]


def test_rounds_are_summed_and_samples_found_per_number_of_frames(tmp_path: Path) -> None:
    home = tmp_path / "results/clip"
    spent = {"wall_s": 1.0, "cpu_s": 2.0, "output_mb": 3.0, "peak_mb": 4.0}
    for setting, frames in (("settings/inspect.max_frames=3/", 3), ("", 5)):
        for file in (f"{setting}stats/ba.json", f"{setting}round1/stats/ba.json"):
            write_json(home / file, spent)
        write_json(home / f"{setting}sequence.json", {"numbers": list(range(frames))})
    samples = {"": {"resident_mb": 70, "meanwhile_mb": 8}, "round1/": {"resident_mb": 90, "meanwhile_mb": 5}}
    write_json(
        tmp_path / bench_long.SAMPLES, {f"results/clip/{home}stats/ba.json": found for home, found in samples.items()}
    )
    short, whole = bench_long.measured(tmp_path, home, ["settings/inspect.max_frames=3/", ""])
    assert (short["n"], short["cpu_s"], short["resident_mb"]) == (3, 4.0, None)
    assert (whole["n"], whole["cpu_s"], whole["resident_mb"], whole["meanwhile_mb"]) == (5, 4.0, 90, 8)


def test_the_table_says_which_stage_misses_which_goal() -> None:
    table = bench_long.table_of(bench_long.with_all(rows()))
    found = {line["stage"]: line for line in table.rows}
    assert found["flow"]["cpu_s"] == "28.0 / 103.0 / 503.0"
    assert found["flow"]["cpu_s_growth"].startswith("1.00 (")
    assert {stage: line["goals"] for stage, line in found.items()} == {
        "flow": "memory met, time met",
        "ba": "MEMORY MISSED, TIME MISSED",
        "scene": "memory not sampled, time met",
        "all": "MEMORY MISSED, TIME MISSED",
    }
    assert found["all"]["resident_mb"] == "350 / 1400 / 7000"
    assert found["all"]["output_mb"] == "300.0 / 1200.0 / 6000.0"
    assert "| CPU, s at 50 / 200 / 1000 |" in table.markdown()


def test_two_numbers_of_frames_determine_no_exponent() -> None:
    table = bench_long.table_of([line for line in rows() if line["n"] < 1000])
    assert {line["cpu_s_growth"] for line in table.rows} == {"too few sizes"}
    assert table.rows[0]["goals"] == "memory met, time not determined"


def test_the_chart_is_drawn_from_the_same_rows() -> None:
    found = bench_long.with_all(rows())
    panels = {label: growth.series_of(found, "frames", measure) for measure, label in bench_long.PANELS.items()}
    for shown in (panels, panels | {"resident memory (MB)": {}}):  # nothing sampled
        assert tradeoff_charts.draw_growths(shown, "frames", {"resident memory (MB)": 6000}).startswith(b"\x89PNG")


def test_the_whole_clip_is_not_run_twice() -> None:
    shipped = yaml.safe_load((bench_long.REPO / "config.yaml").read_text())
    mine = bench_long.scaling_options([50, 200, 1000], 1000)
    _, scaling = settings.compared(shipped | mine, mine)
    assert [setting.value for setting in scaling] == [50, 200, shipped["inspect"]["max_frames"]]


def test_a_scene_is_taken_by_name_or_file_and_kept_as_it_was_drawn(tmp_path: Path) -> None:
    options = bench_long.clip_options("demo", tmp_path, 128, 64, 14)
    home, length = bench_long.find_clip(tmp_path, options)
    assert (home, length) == (tmp_path / "results/simulated/demo", 14)
    drawn = tmp_path / "demo.yaml"
    before = drawn.stat().st_mtime_ns
    time.sleep(0.01)
    assert bench_long.clip_options(str(drawn), tmp_path, 128, 64, 14) == options
    assert drawn.stat().st_mtime_ns == before
    with pytest.raises(InputError, match="no_such_scene"):
        bench_long.clip_options("no_such_scene", tmp_path, 128, 64, 14)


def test_a_wide_scene_is_drawn_small_and_its_first_frames_enlarged(tmp_path: Path) -> None:
    options = bench_long.clip_options("demo", tmp_path, 1024, 128, 3)
    frames = sorted(Path(options["dataset"]).glob("*.png"))
    assert [read_rgb(frame).shape for frame in frames] == [(128, 1024, 3)] * 3
    home, length = bench_long.find_clip(tmp_path, options)
    assert (home, length) == (tmp_path / "results/demo_1024x128/demo_1024x128", 3)


def test_a_folder_with_cuts_is_refused_before_anything_runs(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    for k, image in enumerate(np.repeat(random.integers(0, 255, (2, 48, 64, 3), np.uint8), 4, axis=0)):
        write_image(tmp_path / f"clip/frame_{k + 1:04d}.png", image)
    with pytest.raises(InputError, match="clip_shot1, clip_shot2"):
        bench_long.find_clip(tmp_path, bench_long.clip_options(str(tmp_path / "clip"), tmp_path, 64, 48, 8))


def test_a_size_without_a_sample_has_a_dash() -> None:
    found = rows()
    found[2]["resident_mb"] = None
    flow = next(line for line in bench_long.table_of(found).rows if line["stage"] == "flow")
    assert flow["resident_mb"] == "100 / 400 / -"
