"""Entries of scene.json on effects of the camera: as the adjustment and the lens stage decided."""

from dataclasses import asdict
from typing import Any

import pytest

from stages.ba import distortion, shutter, zoom
from stages.report.effect_tables import _decision as row_of
from stages.scene.camera_effects import camera_decisions
from stages.scene.figure import decision_table


def adjusted(option: str = "auto") -> dict[str, Any]:
    """Metadata of poses: a zoom that was found, and a shutter that was not tested."""
    found = zoom.Evidence("changing", "it saves much", 0.25, 0.03, 0.04, 2.5, 0.3, 0.01)
    options = {"zoom": option, "rolling_shutter": "auto"}
    return {"zoom": asdict(found), "rolling_shutter": asdict(shutter.NOT_TESTED), "options": options}


def test_what_was_decided_before_is_told_on_the_same_terms() -> None:
    lens = asdict(distortion.Evidence("straight", "it saves nothing", -0.001, 0.002, 0.02, 1.0, 0.0004, 0.001))
    found = camera_decisions(adjusted(), lens | {"options": {"distortion": "auto"}})
    assert {name: decision["needed"] for name, decision in found.items()} == {
        "zoom": True,
        "rolling_shutter": False,
        "distortion": False,
    }
    assert found["zoom"]["statistic"] == pytest.approx(25)
    assert found["zoom"]["interval"] == pytest.approx([19, 31])
    assert found["zoom"]["threshold"] == pytest.approx(4)
    assert found["zoom"]["seconds"] == 2.5
    assert found["zoom"]["why"] == "changing: it saves much"
    assert found["distortion"]["evidence"] == {"shift": 0.0004, "shift_sigma": 0.001}


def test_what_was_not_tested_has_no_number_and_is_drawn_all_the_same() -> None:
    found = camera_decisions(adjusted(), None)
    assert "distortion" not in found
    assert found["rolling_shutter"]["statistic"] is None
    assert row_of(found["rolling_shutter"])["modelled"] == "no"
    assert decision_table(found).shape[0] == 2 * 64


def test_an_option_that_overrules_is_named() -> None:
    found = camera_decisions(adjusted("yes"), None)
    assert found["zoom"]["source"] == "user"
    assert found["rolling_shutter"]["source"] == "evidence"
