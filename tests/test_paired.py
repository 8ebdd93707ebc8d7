"""The change that one part of the method brings, against numbers computed by hand."""

from typing import Any

import comparison_tables
import numpy as np
import pytest
import yaml
from conftest import REPO
from scipy import stats

from stages.comparisons import paired
from stages.configuration import compared_runs, settings
from stages.report import paired_report

CLAIM: dict[str, Any] = {"group": "claims"}


@pytest.mark.parametrize("group", paired_report.GROUPS)
def test_a_group_that_is_swept_alone_has_the_run_it_is_compared_with(group: str) -> None:
    shipped = yaml.safe_load((REPO / "config.yaml").read_text())
    raw = shipped | {"sweep": shipped["sweep"] | {"groups": [group]}}
    every = [settings.configured(raw), *settings.compared(raw)[0]]
    runs = [compared_runs.swept_run(every, run, "demo") for run in every[1:]]
    assert sum(run["is_default"] for run in runs) == 1


def _rows(dynamic_db: list[float], seconds: list[float], **changes: Any) -> list[dict[str, Any]]:
    """The configured run at 20 dB on movers and 10 s, and a claim's run, on a sequence for each value."""
    rows = []
    for k, (psnr, cpu) in enumerate(zip(dynamic_db, seconds, strict=True)):
        name = {"sequence": f"s{k}"}
        rows.append(
            comparison_tables.cost_row("as is", 1.0, 9, is_default=True, psnr_dynamic_db=20.0, cpu_s=10.0, **name)
        )
        rows.append(
            comparison_tables.cost_row("less", 2.0, 9, psnr_dynamic_db=psnr, cpu_s=cpu, **CLAIM, **name, **changes)
        )
    return rows


def test_differences_are_paired_by_sequence_with_students_interval() -> None:
    (row,) = paired.paired(_rows([19.0, 18.0, 19.5, 17.5], [5.0, 20.0, 10.0, 10.0]), "claims")
    low, high = stats.ttest_1samp([-1.0, -2.0, -0.5, -2.5], 0.0).confidence_interval(0.95)
    assert row["psnr_dynamic_db"] == f"-1.50 ({low:+.2f} to {high:+.2f})"
    assert row["cpu_s"].startswith("1.00 (")  # half and twice the time: no change in the geometric mean
    assert row["ate_percent"] == "2.00 (2.00 to 2.00)"
    assert row["sequences"] == 4


def test_an_interval_needs_three_sequences_and_holds_nothing_that_failed() -> None:
    (row,) = paired.paired(_rows([19.0, 18.0], [10.0, 10.0]), "claims")
    assert row["psnr_dynamic_db"] == "-1.50"
    (failed,) = paired.paired(_rows([19.0, 18.0], [10.0, 10.0], status="partial", iou=None), "claims")
    assert failed["ate_percent"] is None
    assert failed["iou"] is None


def test_training_to_equal_quality_is_compared_with_the_time_of_the_configured_run() -> None:
    rows = _rows([20.0] * 3, [10.0] * 3, equal_s=6.0, configured_equal_s=3.0)
    (row,) = paired.paired(rows, "claims")
    assert row["equal_s"].startswith("2.00 (")


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    rng = np.random.default_rng(0)
    bounds = [paired.interval(rng.normal(0.3, 1.0, 5)) for _ in range(2000)]
    held = np.mean([abs(mean - 0.3) <= half for mean, half in bounds])
    assert held == pytest.approx(paired.LEVEL, abs=0.02)  # 1.96 standard errors would hold it in 0.88


def test_the_report_has_the_table_where_several_sequences_were_swept() -> None:
    rows = _rows([19.0, 18.0], [10.0, 10.0])
    (table,) = paired_report.paired_tables(rows)
    assert table.title == "Claims of the paper: change from the configured run"
    assert paired_report.paired_tables(rows[:2]) == []
