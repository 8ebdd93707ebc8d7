"""The demo as `make demo` runs it, from its frames to its scores: floors on errors against the truth."""

from typing import Any

import pytest
import yaml
from conftest import REPO, run_snakemake

from stages.results.scorecard import score_rows

OPTIONS: dict[str, Any] = {
    "preset": "fast",
    "render": {"novel_views": 2},
    "colmap": {"time_limit_s": 1},  # the baseline is no part of this
}


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the demo reached."""
    folder = tmp_path_factory.mktemp("demo")
    (folder / "mine.yaml").write_text(yaml.safe_dump(OPTIONS))
    where = ["-s", str(REPO / "Snakefile"), "--directory", str(folder), "--configfile", str(folder / "mine.yaml")]
    done = run_snakemake(folder, "results/simulated/demo/eval/poses.parquet", *where)
    assert done.returncode == 0, done.stderr[-4000:]
    (row,) = score_rows(folder / "results/simulated")
    return row


def test_cameras_keep_their_floors(demo: dict[str, Any]) -> None:
    """Measured: ATE 0.030 to 0.034 % of the path, focal error 0.15 %."""
    assert (demo["status"], demo["warnings"], demo["camera"]) == ("ok", 0, "moving")
    assert demo["ate_percent"] < 0.1
    assert abs(demo["focal_error_percent"]) < 1


def test_masks_keep_their_floors(demo: dict[str, Any]) -> None:
    """Measured: IoU 0.86, precision 0.86, recall 0.99."""
    assert demo["iou"] > 0.8
    assert demo["precision"] > 0.8
    assert demo["recall"] > 0.95


def test_held_out_views_keep_their_floors(demo: dict[str, Any]) -> None:
    """Measured: 32.0 dB whole, 34.0 static, 24.2 moving; 25.9 from the right eye."""
    assert demo["psnr_whole"] > 31
    assert demo["psnr_static"] > 33
    assert demo["psnr_dynamic"] > 23
    assert demo["right_db"] > 24.5
