"""Two runs side by side: paired differences, wins, what only one of them has, and folders that are no runs."""

import subprocess
import sys
from pathlib import Path

import pytest
from conftest import REPO

from stages.comparisons import compare
from stages.shared.errors import InputError
from stages.shared.tables import Row, write_rows


def _write(folder: Path, sequence: str, ate: float | None, psnr: float, seconds: float) -> None:
    """The tables of an evaluated sequence."""
    scores = folder / sequence / "eval"
    status = "ok" if ate is not None else "failed"
    poses: list[Row] = [
        {"method": "COLMAP global", "status": "ok", "ate_percent": 99.0, "focal_error_percent": 9.0},
        {"method": "ours", "status": status, "ate_percent": ate, "focal_error_percent": -2.0},
    ]
    images = [
        {"method": method, "split": split, "region": region, "psnr_db": psnr + offset}
        for method, split, offset in (("blend", "test", 5.0), ("ours", "train", 9.0), ("ours", "test", 0.0))
        for region in ("whole", "static")
    ]
    masks = [{"method": "refined masks", "round": k, "iou": 0.5 + 0.1 * k} for k in (1, 2)]
    spent = (("flow", seconds, 4), ("colmap_masked", 99.0, 64))
    times = [{"stage": stage, "threads": n, "wall_s": s, "cpu_s": 2 * s} for stage, s, n in spent]
    tables: dict[str, list[Row]] = {"poses": poses, "images": images, "masks": masks, "time": times}
    for name, rows in tables.items():
        write_rows(scores / f"{name}.parquet", rows, list(rows[0]), {})


@pytest.fixture
def runs(tmp_path: Path) -> tuple[Path, Path]:
    a, b = tmp_path / "a" / "sintel", tmp_path / "b" / "sintel"
    for name, ate, psnr in (("alley", 1.0, 20.0), ("cave", 2.0, 22.0), ("market", None, 24.0), ("lost", 1.0, 1.0)):
        _write(a, name, ate, psnr, 10)
    for name, ate, psnr in (("alley", 0.5, 21.0), ("cave", 2.25, 21.5), ("market", 3.0, 24.0), ("new", 1.0, 1.0)):
        _write(b, name, ate, psnr, 12)
    return a, b


def _differences(runs: tuple[Path, Path], key: str) -> tuple[dict[str, float], compare.Measure]:
    measure = next(m for m in compare.MEASURES if m.key == key)
    return compare.differences(compare.read_run(runs[0]), compare.read_run(runs[1]), measure), measure


def test_differences_are_paired_by_sequence_and_of_our_last_result(runs: tuple[Path, Path]) -> None:
    changes, measure = _differences(runs, "ate_percent")
    assert changes == {"alley": -0.5, "cave": 0.25}  # market failed in A
    words = compare.summarise(list(changes.values()), measure)
    assert words == "B - A: mean -0.125, median -0.125; B better 1, worse 1, equal 0; n = 2"
    changes, measure = _differences(runs, "psnr_whole")
    assert changes == {"alley": 1.0, "cave": -0.5, "market": 0.0}
    assert "mean +0.17, median +0.00; B better 1, worse 1, equal 1; n = 3" in compare.summarise(
        [*changes.values()], measure
    )
    assert set(_differences(runs, "wall_s")[0].values()) == {2.0}  # without COLMAP's 99
    assert _differences(runs, "iou")[0]["alley"] == 0
    assert compare.read_run(runs[0])["alley"]["iou"] == pytest.approx(0.7)
    assert _differences(runs, "psnr_dynamic")[0] == {}


def test_what_only_one_run_has_is_shown(runs: tuple[Path, Path]) -> None:
    text = compare.describe(compare.read_run(runs[0]), compare.read_run(runs[1]))
    assert "only in A: lost" in text
    assert "threads at most: A 4, B 4" in text
    assert "only in B: new" in text
    lines = text.splitlines()
    assert sum(line.endswith("n = 2; 0 lost by B, 1 gained") for line in lines) == 1  # market's ATE
    assert next(line for line in lines if "alley" in line).split() == ["alley", "1.000", "0.500", "-0.500", "better"]
    assert next(line for line in lines if "market" in line).split() == ["market", "n/a", "3.000"]
    assert next(line for line in lines if line.startswith("  new")).split() == ["new", "n/a", "1.000"]


def test_the_script_prints_and_draws(runs: tuple[Path, Path], tmp_path: Path) -> None:
    picture = tmp_path / "change.svg"
    command = [sys.executable, "-m", "stages.comparisons.compare", *map(str, runs), "--figure", str(picture)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=REPO, check=True)
    assert "B - A: mean" in done.stdout
    assert "alley" in picture.read_text()
    assert "PSNR dynamic" in picture.read_text()


def test_bad_folders_end_in_one_line_and_code_2(runs: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for folder, found in ((tmp_path / "empty", "nothing evaluated"), (tmp_path / "gone", "no such folder")):
        with pytest.raises(InputError, match=found):
            compare.read_run(folder)
    command = [sys.executable, "-m", "stages.comparisons.compare", str(runs[0]), str(tmp_path / "gone")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=REPO, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert len(done.stderr.splitlines()) == 1
    assert "gone" in done.stderr
    (runs[1] / "alley" / "eval" / "images.parquet").write_bytes(b"broken")
    with pytest.raises(InputError, match="images"):
        compare.read_run(runs[1])


def test_a_loss_is_one_beyond_the_noise(runs: tuple[Path, Path]) -> None:
    a, b = (compare.read_run(run) for run in runs)
    assert compare.losses(a, b) == [
        *("lost: only in A", "cave: ATE 2.000 -> 2.250", "cave: PSNR 22.00 -> 21.50"),
        *("cave: PSNR static 22.00 -> 21.50", "all: CPU time 60.0 -> 72.0 s"),
    ]
    assert compare.losses(a, a) == []
    a = {"alley": b["alley"] | {"iou": 0.7, "cpu_s": 100.0, "ate_percent": 2.0}}
    within = {"alley": a["alley"] | {"iou": 0.691, "cpu_s": 102.9, "ate_percent": 2.19, "wall_s": 999.0}}
    assert compare.losses(a, within) == []
    for change in ({"iou": 0.689}, {"cpu_s": 103.1}, {"ate_percent": None}, {"psnr_whole": 20.8}):
        assert len(compare.losses(a, {"alley": within["alley"] | change})) == 1
    assert compare.losses(a, {"alley": within["alley"] | {"ate_percent": 0.1, "iou": 0.9, "cpu_s": 1.0}}) == []
