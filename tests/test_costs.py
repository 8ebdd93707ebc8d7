"""The time of a killed run counts where its work does."""

from pathlib import Path

from stages.shared import cli, costs
from stages.shared.artifacts import read_json
from stages.shared.options import Options


def test_a_run_counts_what_the_killed_run_before_had_spent(tmp_path: Path) -> None:
    killed = costs.spent() | {"wall_s": 1000.0, "cpu_s": 2000.0, "peak_mb": 1e6, "gpu_peak_mb": 3.0}
    assert costs.spent()["taken_over_s"] == 0
    costs.take_over(killed)
    found = costs.spent()
    assert 1000 < found["wall_s"] < 2000
    assert 2000 < found["cpu_s"] < 4000
    assert (found["taken_over_s"], found["peak_mb"], found["gpu_peak_mb"]) == (1000.0, 1e6, 3.0)
    costs.take_over(found | {"wall_s": 1500.0})  # killed twice
    assert 1500 < costs.spent()["wall_s"] < 2500
    cli._write_stats(tmp_path / "ba.json", "ba", "done", [], Options())
    assert read_json(tmp_path / "ba.json")["taken_over_s"] == 1500.0


def test_only_work_of_the_same_origin_is_taken_over(tmp_path: Path) -> None:
    folder = tmp_path / "work"
    assert not costs.goes_on(folder, "here")
    assert not folder.exists()
    costs.begin(folder, "here")
    costs.keep(folder)
    assert costs.goes_on(folder, "here")
    assert costs.spent()["taken_over_s"] == read_json(folder / costs.SPENT)["wall_s"] > 0
    assert not costs.goes_on(folder, "there")
    assert not folder.exists()


def test_damaged_costs_do_not_cost_the_work(tmp_path: Path) -> None:
    """They are written after every block, and what was written last is what a power cut damages."""
    costs.begin(tmp_path, "here")
    costs.keep(tmp_path)
    costs.begin(tmp_path, "here")
    kept = tmp_path / costs.SPENT
    kept.write_bytes(kept.read_bytes()[:20])
    assert costs.goes_on(tmp_path, "here")
    assert costs.spent()["taken_over_s"] == 0
