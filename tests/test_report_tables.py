"""Tables and charts of the report by themselves: means, published numbers, digits, which paths are drawn."""

from typing import Any

import pytest
import yaml
from conftest import REPO

from stages.evaluate import ratios, summaries
from stages.report import published
from stages.shared import charts
from stages.shared.tables import decimal

PUBLISHED = REPO / "workflow" / "resources" / "published.yaml"


def _pose_row(sequence: str, status: str = "ok", **changes: float | str | None) -> dict[str, Any]:
    keys = ("ate", "ate_percent", "rpe_trans", "rpe_rot_deg", "focal_error_percent", "wall_s", "cpu_s")
    keys += ("threads", "taken")
    return {"sequence": sequence, "method": "ours", "status": status, **dict.fromkeys(keys), **changes}


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


def test_ratios_take_the_best_complete_variant_of_colmap_and_count_who_is_beaten() -> None:
    def poses(sequence: str, ours: float | None, *colmap: float | None) -> list[dict[str, Any]]:
        methods = ("ours", "COLMAP global", "COLMAP incremental, x2", "COLMAP global, with our prior above one half")
        return [
            _pose_row(sequence, "failed" if error is None else "ok", method=method, ate_percent=error)
            for method, error in zip(methods, (ours, *colmap), strict=False)
        ]

    listed = [
        *poses("lower", 0.2, 0.5, 0.4, 0.1),  # what COLMAP gains from our masks is no rival
        *poses("higher", 0.3, 0.1, None),
        *poses("alone", 0.3, None, None),
        *poses("lost", None, 0.1, 0.1),
        *poses("both lost", None, None, None),
        *poses("not run", 0.3),
        _pose_row("still", "degenerate truth: static camera"),
        _pose_row("blind", "no truth"),
    ]
    masks = (("lower", 0.1, "ok"), ("higher", 0.2, "ok"), ("lost", 0.2, "ok"), ("alone", None, "failed"))
    true_masks = {"overrides": '{"segment.source": "truth"}'}
    settings = [{"sequence": n, "ate_percent": e, "status": s} | true_masks for n, e, s in masks]
    other = {"sequence": "lower", "ate_percent": 9.0, "status": "ok"}
    more = {"overrides": '{"segment.source": "truth", "flow.source": "truth"}'}
    table = ratios.ratio_table(listed, [other | {"overrides": "{}"}, other | more, *settings])
    keys = ("sequence", "colmap", "colmap_ratio", "true_masks_ratio")
    assert [tuple(row[key] for key in keys) for row in table.rows] == [
        ("lower", "COLMAP incremental, x2", pytest.approx(0.5), pytest.approx(2.0)),
        ("higher", "COLMAP global", pytest.approx(3.0), pytest.approx(1.5)),
        ("alone", "none complete", None, None),
        ("lost", "COLMAP global", None, None),
        ("both lost", "none complete", None, None),
    ]
    assert table.note == (
        "Lower than the best of COLMAP without masks on 2 of 5 sequences (1 of these: COLMAP has no complete path). "
        "At most 1.5 times the error with true masks on 1 of 3 sequences."
    )
    assert ratios.ratio_table([row for row in listed if row["method"] == "ours"], []).rows == []


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
            *(
                ("COLMAP global", 5, 0.4),
                ("COLMAP global, x2", 5, 0.2),
                ("COLMAP global, with our refined masks", 3, 0.1),
            ),
            *(("COLMAP incremental", 2, None), ("COLMAP incremental, with our refined masks", 4, None)),
        )
        for k in range(frames)
    ]
    assert list(charts.paths_of(rows)) == [
        "truth",
        "ours",
        "COLMAP global, x2",
        "COLMAP incremental, with our refined masks",
    ]
