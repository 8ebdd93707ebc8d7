"""The file or flag that a line about a wrong option names: the one in which the value stands."""

from pathlib import Path
from typing import Any

import pytest
from conftest import REPO, run_snakemake

from stages.configuration import given_inputs, settings, sources
from stages.shared.errors import InputError, OptionError

SHIPPED = {"shots": "auto", "ba": {"zoom": "auto", "start_focals": [1.05]}, "sweep": {"knobs": {"flow.offsets": [[1]]}}}


@pytest.mark.parametrize(
    ("place", "own", "named"),
    [
        (["ba", "zoom"], [("a.yaml", {"ba": {"zoom": 1}}), ("b.yaml", {"ba": {}})], "a.yaml"),
        (["ba", "zoom"], [("a.yaml", {"ba": {"zoom": 1}}), ("b.yaml", {"ba": {"zoom": 2}})], "b.yaml"),
        (["ba", "zoom"], [("a.yaml", {"ba": {"zoom": 1}}), ("--config", {"ba": {"zoom": 2}})], "--config"),
        (["ba", "zoom"], [("a.yaml", {"ba": {"stride_px": 4}}), ("--config", {})], "config.yaml"),
        (["ba", "zom"], [("a.yaml", {"ba": {"zom": 1}})], "a.yaml"),
        (["ba", "start_focals", "0"], [("a.yaml", {"ba": {"start_focals": [9]}})], "a.yaml"),
        (["ba"], [("a.yaml", {"ba": 3})], "a.yaml"),
        (["shots", "1"], [("a.yaml", {"shots": {1: "maybe"}})], "a.yaml"),
        (["sweep", "knobs", "flow.offsets"], [("a.yaml", {"sweep": {"presets": []}})], "config.yaml"),
        (["motion", "seed"], [("a.yaml", {"ba": {"zoom": 1}})], "the configuration"),
    ],
)
def test_the_last_file_that_holds_the_value_is_named(place: list[str], own: list[Any], named: str) -> None:
    error = sources.named(OptionError(place, "this", "that", "correct it"), [("config.yaml", SHIPPED), *own])
    assert str(error) == f"{named}: {'.'.join(place)}: expected this, found that; correct it"


def test_an_error_about_something_else_stays_as_it_is() -> None:
    error = InputError("clip.mp4", "a video", "a page", "replace it")
    assert sources.named(error, [("config.yaml", SHIPPED)]) is error


def test_a_file_in_the_working_folder_goes_by_its_short_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert sources.shown(tmp_path / "folder/mine.yaml") == "folder/mine.yaml"
    assert sources.shown(Path("/elsewhere/mine.yaml")) == "/elsewhere/mine.yaml"


def test_a_path_of_a_setting_is_refused_where_the_setting_stands() -> None:
    raw = {"sweep": {"runs": {"masks": {"mine": {"segment.source": "/nowhere"}}}}}
    (setting,), _ = settings.compared(raw)
    own = [("config.yaml", raw | {"segment": {"source": "refined"}}), ("mine.yaml", raw)]
    with pytest.raises(InputError) as refused:
        given_inputs.check([(setting, [])])
    said = str(sources.named(refused.value, own))
    assert said.startswith("mine.yaml: setting 'mine' of 'masks': segment.source: expected refined")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--configfile", "mine.yaml"], "mine.yaml: ba.zoom: expected 'auto', 'yes' or 'no', found 'maybe'"),
        (["--configfile", "mine.yaml", "--config", "ba={zoom: perhaps}"], "--config: ba.zoom: expected"),
        (["--configfile", "other.yaml"], "other.yaml: setting 'preset=fastest' of 'knobs': preset: expected"),
    ],
)
def test_a_run_names_the_users_own_file_or_flag(tmp_path: Path, arguments: list[str], said: str) -> None:
    (tmp_path / "mine.yaml").write_text("ba: {zoom: maybe}")
    (tmp_path / "other.yaml").write_text("sweep: {knobs: {preset: [fastest]}}")
    refused = run_snakemake(tmp_path, "-s", str(REPO / "Snakefile"), "-n", *arguments)
    assert refused.returncode == 2
    assert said in refused.stderr.splitlines()[-1]
