"""What accuracy costs: the front, the price of the next tenth, and the growth, against numbers that are known."""

from typing import Any

import comparison_tables
import numpy as np
import pytest

from stages.comparisons import growth, tradeoff
from stages.comparisons.tradeoff import Point
from stages.report import tradeoff_report


def _point(seconds: float, error: float, name: str = "p", complete: bool = True, is_default: bool = False) -> Point:
    return Point(seconds, error, name, name, complete, is_default)


def test_front_holds_what_no_complete_point_beats_in_both() -> None:
    rng = np.random.default_rng(0)
    points = [_point(s, e, str(k)) for k, (s, e) in enumerate(rng.integers(0, 12, (60, 2)).astype(float))]
    found = {(p.seconds, p.error) for p in tradeoff.pareto_front(points)}

    def beaten(p: Point) -> bool:
        return any(
            q.seconds <= p.seconds and q.error <= p.error and (q.seconds, q.error) != (p.seconds, p.error)
            for q in points
        )

    assert found == {(p.seconds, p.error) for p in points if not beaten(p)}
    assert len(tradeoff.pareto_front(points)) == len(found)  # equal points once
    fast_but_failing = _point(-1, -1, complete=False)
    assert tradeoff.pareto_front([*points, fast_but_failing]) == tradeoff.pareto_front(points)


def test_next_tenth_is_priced_by_measured_settings_alone() -> None:
    start = _point(10, 1.0, "balanced", is_default=True)
    slower = _point(30, 0.81, "accurate")  # two tenths: 0.9 * 0.9
    assert "the next tenth costs 10.0 s: accurate gives 0.81 in 30 s, 19 % less for 20 s more" in tradeoff.next_tenth(
        [start, slower], "ATE"
    )
    words = tradeoff.next_tenth([start, slower, _point(9, 0.5, "lucky")], "ATE")
    assert "costs no time: lucky" in words
    assert "no measured setting is a tenth better" in tradeoff.next_tenth([start, _point(20, 0.95, "b")], "ATE")
    assert "more than 1 % better" in tradeoff.next_tenth([start, _point(20, 2.0, "b")], "ATE")
    failing = _point(10, 1.0, "balanced", complete=False, is_default=True)
    assert "no cost" in tradeoff.next_tenth([failing, slower], "ATE")


def test_settings_are_means_over_sequences_and_failures_are_counted() -> None:
    rows = [
        comparison_tables.cost_row("fast", 1.0, 10, focal_error_percent=-4.0),
        comparison_tables.cost_row("fast", 3.0, 20, psnr=30.0, sequence="b", focal_error_percent=2.0),
        comparison_tables.cost_row("fast", 99.0, 30, psnr=25.0, sequence="c", status="partial"),
        comparison_tables.cost_row("fast", None, 40, psnr=25.0, sequence="d", status="failed"),
    ]
    (mean,) = tradeoff.means(rows)
    assert (mean["ate_percent"], mean["focal_abs_percent"]) == (2.0, 3.0)
    assert (mean["psnr_db"], mean["wall_s"]) == (25.0, 25.0)
    assert (mean["n"], mean["sequences"], mean["failed"]) == (2, 4, 2)


def test_the_report_draws_settings_beside_colmap_and_lists_every_group() -> None:
    pose = {"status": "ok", "taken": None, "ate": 0.1, "rpe_trans": 0.1, "rpe_rot_deg": 0.1}
    pose |= {"focal_error_percent": 1.0, "cpu_s": 9.0}
    poses = [
        {"sequence": "wall", "method": "COLMAP global", "ate_percent": 7.0, "wall_s": None, **pose},
        {"sequence": "not swept", "method": "COLMAP global", "ate_percent": 900.0, "wall_s": None, **pose},
    ]
    sentence, figures, tables = tradeoff_report.sweep_part(comparison_tables.cost_rows(), poses)
    assert "(1.00 in 30 s) the next tenth costs" in sentence
    assert [figure.title for figure in figures] == ["ATE against time", "PSNR against time", "ba.stride_px"]
    assert "COLMAP global: 7 in 9 s" in figures[0].alt
    assert "PSNR (dB) of 4: 20 in 90 s" in figures[2].alt
    titles = ["Presets", "Single knobs", "Effect of masks on pose error", "Training to equal PSNR"]
    assert [table.title for table in tables] == titles
    assert "balanced" not in {row["setting"] for row in tables[3].rows}  # the configured run, which others stand beside
    fronts = {row["setting"]: row["front"] for row in tables[0].rows}
    assert fronts == {"fast": "ATE, PSNR", "balanced": "ATE, PSNR", "accurate": "ATE, PSNR"}
    knobs = {row["value"]: row["front"] for row in tables[1].rows}
    assert knobs == {"4": "ATE", "8": "ATE, PSNR", "16": "ATE, PSNR"}  # 8 is balanced, under another name
    masks = tables[2].rows
    assert [row["setting"] for row in masks] == ["as configured", "true"]
    assert masks[1]["front"] == ""  # truth is no choice


def test_the_effect_of_masks_is_told_per_sequence_where_several_were_swept() -> None:
    changes: dict[str, Any] = {"group": "masks", "iou": 0.7, "boundary_f": 0.6, "focal_error_percent": -3.0}
    rows = [comparison_tables.cost_row("prior", a, 9, sequence=s, **changes) for s, a in (("a", 0.1), ("b", 0.2))]
    assert tradeoff_report.sequence_tables(rows[:1]) == []
    (table,) = tradeoff_report.sequence_tables([*rows, comparison_tables.cost_row("fast", 1.0, 9)])
    keys = ("sequence", "setting", "ate_percent", "focal_abs_percent", "iou", "boundary_f")
    assert [tuple(row[key] for key in keys) for row in table.rows] == [
        ("a", "prior", 0.1, 3.0, 0.7, 0.6),
        ("b", "prior", 0.2, 3.0, 0.7, 0.6),
    ]


def test_growth_is_recovered_beside_its_fixed_part() -> None:
    n = np.array([5.0, 10, 20, 40, 80])
    law = growth.fit_growth(n, 2 + 0.03 * n**1.5)
    assert law is not None
    assert (law.fixed, law.factor, law.exponent) == pytest.approx((2, 0.03, 1.5), rel=1e-6)
    assert law.low < 1.5 < law.high
    assert law.deviation_percent == pytest.approx(0, abs=1e-6)
    noisy = growth.fit_growth(n, (2 + 0.03 * n) * np.array([1.04, 0.97, 1.03, 0.98, 1.02]))
    assert noisy is not None
    assert noisy.low <= 1 <= noisy.high  # a power law alone would say 0.26
    flat = growth.fit_growth(n, np.array([300.0, 301, 299, 302, 303]))
    assert flat is not None
    assert flat.words() == "constant"
    assert growth.fit_growth(n[:2], n[:2]) is None


def test_growth_is_tabled_and_drawn_per_axis() -> None:
    figures, (table,) = tradeoff_report.growth_part(comparison_tables.growth_rows())
    found = {(row["axis"], row["stage"]): row for row in table.rows}
    assert found["frames", "ba"]["wall_s_growth"].startswith("1.50 (")
    assert found["frames", "ba"]["fixed_s"] == pytest.approx(0, abs=1e-9)
    assert found["frames", "ba"]["peak_mb_growth"] == "constant"
    assert found["pixels", "flow"]["wall_s_growth"] is None
    assert found["frames", "flow"]["output_mb_growth"].startswith("1.00 (")
    assert len(figures) == 6
    assert "flow 5 to 20" in figures[0].alt
    assert "disk (MB) of every stage against frames: flow 30 to 120" in figures[2].alt


def test_a_growth_that_was_collected_without_disk_is_still_shown() -> None:
    rows = [{key: row[key] for key in row if key != "output_mb"} for row in comparison_tables.growth_rows()]
    figures, (table,) = tradeoff_report.growth_part(rows)
    assert len(figures) == 4
    assert {row["output_mb_growth"] for row in table.rows} == {None}
