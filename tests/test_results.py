"""The page of results: every scene stands in it, whatever became of it, and the README repeats what it says."""

import shutil
from pathlib import Path
from typing import Any

import comparison_tables
import finished_run as run
import pytest
import yaml
from conftest import REPO

from stages.comparisons import made_under
from stages.evaluate import image_baselines
from stages.results import __main__ as results_stage
from stages.results import scene_tables, scorecard
from stages.results.options import ResultsOptions
from stages.shared.artifacts import write_json
from stages.shared.errors import InputError

OPTIONS = ResultsOptions(command="make results PRESET=fast")


def _scene(name: str, status: str = "ok", **figures: Any) -> dict[str, Any]:
    return {"sequence": name, "split": "test", "status": status, "warnings": 0, **figures}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The working folder of a run of three scenes: one done, one that stopped before the training, one without files.

    The first is a test scene by its manifest, the others are by their files a tuned and a test scene.
    """
    root = tmp_path_factory.mktemp("results")
    done = run.finish(root, "wall")
    write_json(done / "stats/evaluate.json", {"stage": "evaluate", "code": "abc", "options": {}})
    write_json(root / "simulated/wall.json", {"split": "test"})
    shutil.copytree(done, root / "results/stopped", ignore=shutil.ignore_patterns("gaussians.json", "eval"))
    (root / "scenes").mkdir()
    for name, split in (("stopped", "tuned"), ("never_begun", "test")):
        (root / f"scenes/{name}.yaml").write_text(yaml.safe_dump({"split": split}))
    return root


def _write(root: Path, **more: Path) -> str:
    output = root / "page.md"
    results_stage.main(root / "results", output, OPTIONS, scenes=root / "scenes", manifests=root / "simulated", **more)
    return output.read_text()


def test_the_page_says_by_which_command_it_was_made(finished: Path) -> None:
    assert "`make results PRESET=fast`, 20" in _write(finished)


def test_scenes_without_results_are_failures_and_no_scene_is_dropped(finished: Path) -> None:
    text = _write(finished)
    test, tuned = text.partition("## Test scenes")[2].split("## Tuned scenes")
    assert "| wall | 8 | moving | flagged" in test
    assert "| never_begun |  |  | no results of inspect |" in test
    assert "2 scenes: failed or partial 0, flagged by the adjustment 1 (wall), " in test
    assert "without results of every stage 1 (never_begun)." in test
    assert "| stopped | no results of gaussians |" in tuned
    assert "wall" not in tuned.partition("## Medians")[0]


def test_a_row_holds_what_the_tables_say(finished: Path) -> None:
    row = next(row for row in scorecard.score_rows(finished / "results") if row["sequence"] == "wall")
    assert row["split"] == scorecard.OWN  # nobody said where the simulator's notes lie
    assert row["ate_percent"] < 1e-9
    assert 0.2 < row["mover_iou"] < 0.9  # a part of the wall counts as at rest in all of its frames
    assert (row["iou"], row["precision"], row["recall"], row["masks"]) == (1, 1, 1, "refined masks")
    assert row["colmap_error"] == "partial"
    assert (row["psnr_whole"], row["warp_whole"]) == (pytest.approx(28, abs=8), None)  # no edge over the frame between
    assert row["wall_s"] == 2.0 * 13
    assert (row["threads"], row["colmap_threads"]) == (2, 1)
    assert row["flags"] == "a warning; one more"
    assert "ba" in row["old"]  # its time file was written by other code than this checkout's


def test_ours_minus_warping_is_of_the_same_frames(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Warping leaves out frames without an edge; a difference of means over other frames would say nothing."""
    read = scorecard.read_rows

    def with_warp(frames: int) -> dict[str, Any]:
        def rows(path: Path) -> list[dict[str, Any]]:
            found = read(path)
            if path.name != "images.parquet":
                return found
            ours = [row for row in found if (row["method"], row["split"]) == ("ours", "test")]
            scores = {"method": image_baselines.WARP, "psnr_db": 20.0, "ssim": 0.5}
            return found + [row | scores | {"frames": frames * row["frames"]} for row in ours]

        monkeypatch.setattr(scorecard, "read_rows", rows)
        return scorecard.score_row(finished / "results/wall")

    same, other = with_warp(1), with_warp(2)
    assert same["gain_whole"] == pytest.approx(same["psnr_whole"] - 20)
    assert (same["warp_ssim_whole"], other["gain_whole"]) == (0.5, None)
    table = scene_tables.view_table([same | {"sequence": "wall"}, _scene("a", gain_whole=-1.26, gain_static=0.5)])
    assert table.rows[1]["gain"] == "-1.3 / 0.50 / n/a"


def test_medians_and_means_count_what_they_leave_out() -> None:
    rows = [
        _scene("a", ate_percent=1.0, focal_error_percent=-4.0, colmap_percent=2.0, colmap_error="2.000 %"),
        _scene("b", ate_percent=2.0, focal_error_percent=2.0, colmap_error="failed"),
        _scene("c", "partial", ate_percent=100.0, colmap_error="partial"),
        _scene("d", "failed", failure="no model"),
        _scene("e", ate_percent=6.0, colmap_percent=3.0, colmap_error="3.000 %", warnings=2),
        _scene("f", "degenerate truth: straight camera", rotation_deg=0.5, colmap_error="0.2 deg"),
    ]
    table = scene_tables.figure_table({"test": rows})
    found = {row["figure"]: (row["test_median"], row["test_mean"], row["test_n"]) for row in table.rows}
    assert found["camera error (ATE), % of path"] == ("2.000", "3.000", "3 of 6")
    assert found["focal error, %"] == ("3.00", "3.00", "2 of 6")
    assert found["rotation error where no ATE is defined, degrees"] == ("0.500", "0.500", "1 of 6")
    assert list(scene_tables.parts_of([_scene("g") | {"split": "new"}, *rows])) == ["test", scorecard.OWN]
    told = scene_tables.counts(rows)
    assert told.startswith(
        "6 scenes: failed or partial 2 (c, d), flagged by the adjustment 1 (e), wrong and not flagged 2 (b, f),"
    )
    # Of a, b, c and e, for which COLMAP ran on a curved path: a is more accurate, b alone has a path.
    assert "Lower than the best of COLMAP without masks on 2 of 4 sequences" in told
    assert scene_tables.result_of(rows[5]) == "wrong, not flagged, straight camera"
    assert scene_tables.result_of(rows[0]) == "ok"


def test_the_block_of_the_readme_is_replaced_and_nothing_else(finished: Path) -> None:
    readme = finished / "README.md"
    readme.write_text(f"before\n{results_stage.BEGIN}\nold\n{results_stage.END}\nafter\n")
    text = _write(finished, readme=readme)
    block = (
        results_stage.BEGIN + text.partition(results_stage.BEGIN)[2].partition(results_stage.END)[0] + results_stage.END
    )
    assert readme.read_text() == f"before\n{block}\nafter\n"
    readme.write_text("no marks")
    with pytest.raises(InputError, match="put them where the summary belongs"):
        _write(finished, readme=readme)
    assert readme.read_text() == "no marks"


def test_a_sweep_stands_on_the_page_only_if_it_belongs_to_the_run(finished: Path) -> None:
    assert "There is no sweep for this run" in _write(finished)
    stages = [{"sequence": "wall", "stages": {"flow": 1, "ba": 2}}]
    comparison_tables.write(finished / "results", made_under.of_runs(finished / "results", stages))
    assert "### Presets" in _write(finished)
    earlier = {"frames": "others", "flow": {"options": {"seed": 5}, "code": "abc", "ran": 1}}
    comparison_tables.write(finished / "results", {"wall": earlier})
    text = _write(finished)
    assert "made under other options or code: other frames; flow.seed 5, now 0." in text
    assert "### Presets" not in text


def test_data_of_ones_own_without_truth_have_a_page_too(tmp_path: Path) -> None:
    folder = run.finish(tmp_path, "mine", truth=False)
    write_json(folder / "stats/evaluate.json", {"stage": "evaluate", "code": "abc", "options": {}})
    results_stage.main(folder.parent, tmp_path / "page.md", ResultsOptions())
    text = (tmp_path / "page.md").read_text()
    assert "| mine | 8 | moving | flagged, no truth, older code |" in text
    assert "mask IoU" not in text.partition("## Medians")[2]
    with pytest.raises(InputError, match="name a folder results/<dataset>"):
        results_stage.main(tmp_path, tmp_path / "other.md", ResultsOptions())


def test_the_readme_says_what_the_page_says() -> None:
    blocks = [
        (REPO / name).read_text().partition(results_stage.BEGIN)[2].partition(results_stage.END)[0]
        for name in ("README.md", "docs/results.md")
    ]
    assert blocks[0] == blocks[1] != ""
