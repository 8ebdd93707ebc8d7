"""Tables and charts of the report by themselves: means, published numbers, digits, which paths are drawn."""

from typing import Any

import pytest
import yaml
from conftest import REPO

from stages.eval import plots, published, summaries
from stages.eval.tables import decimal

PUBLISHED = REPO / "workflow" / "resources" / "published.yaml"


def _pose_row(sequence: str, status: str = "ok", **errors: float | None) -> dict[str, Any]:
    keys = ("ate", "ate_percent", "rpe_trans", "rpe_rot_deg", "focal_error_percent", "wall_s", "cpu_s")
    return {"sequence": sequence, "method": "ours", "status": status, **dict.fromkeys(keys), **errors}


def test_means_leave_out_failures_but_count_them() -> None:
    rows = [
        _pose_row("a", ate=1.0, focal_error_percent=-4.0),
        _pose_row("b", ate=3.0, focal_error_percent=2.0),
        _pose_row("c", "partial", ate=100.0),
        _pose_row("d", "failed"),
    ]
    (mean,) = summaries.pose_means(rows)
    assert (mean["ate"], mean["focal_abs_percent"]) == (2.0, 3.0)
    assert (mean["n"], mean["sequences"], mean["partial"], mean["failed"]) == (2, 4, 1, 1)


def test_measured_means_join_published_rows_only_on_all_14_sequences() -> None:
    numbers = yaml.safe_load(PUBLISHED.read_text())
    names = numbers["sintel_sequences"]
    rows = [_pose_row(name, ate=0.08, rpe_trans=0.03, rpe_rot_deg=0.5) for name in names]
    rows.append(_pose_row("alley_1", ate=99.0, rpe_trans=99.0, rpe_rot_deg=99.0))  # in Sintel, not of the 14
    rows += [row | {"method": "COLMAP", "status": "failed" if row["sequence"] == "cave_2" else "ok"} for row in rows]
    complete = published.pose_table(numbers, rows)
    ours, colmap = (next(row for row in complete.rows if row["method"] == name) for name in ("ours", "COLMAP"))
    assert ours["ate"] == pytest.approx(0.08)
    assert colmap["ate"] is None
    assert colmap["notes"] == "no mean: 13 of the 14 sequences are scored"
    errors = [row["ate"] for row in complete.rows if row["ate"] is not None]
    assert errors == sorted(errors)
    assert "not the same data" not in complete.title


def test_other_data_stand_apart_from_published_rows() -> None:
    numbers = yaml.safe_load(PUBLISHED.read_text())
    rows = [_pose_row(name, ate=0.08, rpe_trans=0.03, rpe_rot_deg=0.5) for name in numbers["sintel_sequences"][:-1]]
    apart = published.pose_table(numbers, [*rows, _pose_row("my_video", ate=0.01)])
    assert "not the same data" in apart.title
    assert "holds 13 of these 14" in apart.note
    assert all(row["source"] != "this report" for row in apart.rows)
    assert "not the same data" in published.image_table(numbers).title


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (12.345, 2, "12.35"),
        (0.031, 2, "0.031"),
        (0.00038, 4, "0.00038"),
        (0.0, 2, "0.00"),
        (1e-14, 2, "0.00"),
        (-0.2333, 1, "-0.23"),
    ],
)
def test_small_numbers_keep_two_significant_digits(value: float, digits: int, text: str) -> None:
    assert decimal(value, digits) == text


def test_published_numbers_carry_their_source() -> None:
    numbers = yaml.safe_load(PUBLISHED.read_text())
    assert len(numbers["sintel_sequences"]) == 14
    for part in ("poses", "images"):
        assert numbers[part]["protocol"]
        assert all(row["source"] for row in numbers[part]["rows"])
    paper = next(row for row in numbers["poses"]["rows"] if row["method"] == "4D3R")
    assert (paper["ate"], paper["rpe_trans"], paper["rpe_rot_deg"]) == (0.086, 0.035, 0.639)


def test_charts_show_the_best_variant_of_every_colmap_mapper() -> None:
    rows = [
        {"method": method, "frame": k, "x": float(k), "y": 0.0, "z": 0.0, "error": error}
        for method, frames, error in (
            *(("truth", 5, None), ("ours, round 1", 5, 0.1), ("ours", 5, 0.1)),
            *(("COLMAP global", 5, 0.4), ("COLMAP global, x2", 5, 0.2), ("COLMAP global, masked", 3, 0.1)),
            *(("COLMAP incremental", 2, None), ("COLMAP incremental, masked", 4, None)),
        )
        for k in range(frames)
    ]
    assert list(plots.paths_of(rows)) == ["truth", "ours", "COLMAP global, x2", "COLMAP incremental, masked"]
