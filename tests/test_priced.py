"""Decided effects against all and none: the right runs, figures by hand, and goals that are met and missed."""

import json
import math
import shutil
from pathlib import Path
from typing import Any, Literal, get_args

import comparison_tables
import finished_run
import pytest
import yaml
from conftest import REPO

from stages.comparisons import priced
from stages.configuration import compared_runs, plan, settings
from stages.configuration import config as configuration
from stages.configuration.settings import Setting
from stages.report import priced_report
from stages.results import priced as page
from stages.results.options import ResultsOptions
from stages.scene.options import SceneOptions
from stages.shared.artifacts import write_json
from stages.shared.errors import InputError
from stages.shared.tables import read_rows, write_rows

SHIPPED = yaml.safe_load((REPO / "config.yaml").read_text())
OF_CAMERA = {"lens.distortion", "ba.zoom", "ba.rolling_shutter"}


def effects(**raw: Any) -> dict[str, Setting]:
    """The shipped settings of the group by name, with the configured run as ""."""
    values = SHIPPED | raw | {"sweep": SHIPPED["sweep"] | {"groups": [priced.GROUP]}}
    listed = [settings.configured(values), *settings.compared(values)[0]]
    return {setting.name: setting for setting in listed}


def scene(name: str, **changes: tuple[Any, Any, Any]) -> list[dict[str, Any]]:
    """The rows of a scene under decided, all and none: 60, 100 and 40 s, the same scores unless `changes` say else."""
    columns: dict[str, tuple[Any, Any, Any]] = {"cpu_s": (60.0, 100.0, 40.0), "psnr_dynamic_db": (20.0, 20.0, 18.0)}
    columns |= {"psnr_db": (30.0, 30.0, 30.0), "ate_percent": (1.0, 1.0, 1.0), "differing_cpu_s": (50.0, 90.0, 30.0)}
    columns |= changes
    return [
        comparison_tables.cost_row(setting, None, 9, group=priced.GROUP, sequence=name)
        | {key: values[k] for key, values in columns.items()}
        for k, setting in enumerate(priced.SETTINGS)
    ]


def goals(*rows: list[dict[str, Any]]) -> list[bool]:
    return [found.is_met for found in priced.statements(priced.scenes_of([row for of in rows for row in of]))]


def test_every_effect_is_decided_on_or_off_in_the_three_runs() -> None:
    found = effects()
    assert list(found) == ["", *priced.SETTINGS]
    fields = SceneOptions.model_fields.items()
    of_scene = {f"scene.{name}" for name, field in fields if "yes" in get_args(field.annotation)} - {
        "scene.rotation_only"  # a finding: nothing is modelled where the camera only turns
    }
    assert {name: set(run.overrides) for name, run in found.items()} == {
        "": set(),
        "decided": OF_CAMERA | of_scene,
        "all": OF_CAMERA | of_scene,
        "none": OF_CAMERA | of_scene | {"segment.source"},
    }
    words: dict[str, Literal["yes", "no"]] = {"all": "yes", "none": "no"}
    for name, word in words.items():
        given = {option: getattr(*_option(found[name], option)) for option in sorted(OF_CAMERA | of_scene)}
        assert given == dict.fromkeys(given, word)
        assert f"--zoom {word} --rolling-shutter {word}" in configuration.flags(found[name].config, "ba")
    assert found["none"].config.segment.source == "none"


def _option(setting: Setting, option: str) -> tuple[Any, str]:
    section, _, name = option.partition(".")
    return getattr(setting.config, section), name


def test_the_decided_run_is_the_configured_one_and_all_share_the_flow() -> None:
    found = effects()
    every = list(found.values())
    homes = {name: plan.find_home(every, run, "lens", 3) for name, run in found.items()}
    assert homes == {"": "", "decided": "", "all": "settings/effects-all/", "none": "settings/effects-none/"}
    run = compared_runs.swept_run(every, found["all"], "demo")
    assert run["shared"] == ["inspect", "colmap", "flow"]
    assert "demo/settings/effects-all/scene.json" in compared_runs.needed_files(run)
    assert compared_runs.swept_run(every, found["decided"], "demo")["is_default"]


def test_a_lens_is_left_alone_where_cameras_are_given() -> None:
    """They are of the frames as they are: a run that asks for undistorted ones would stop every plan."""
    found = effects(intrinsics=1200)
    assert {run.config.lens.distortion for run in found.values()} == {"no"}
    assert found["all"].config.ba.rolling_shutter == "yes"
    assert found["all"].config.ba.zoom == "auto"
    fixed = effects(intrinsics=1200, ba={"poses_from": "a.tum"})
    assert {run.config.ba.rolling_shutter for run in fixed.values()} == {"auto"}


def test_a_zoom_that_is_asked_for_is_left_out_of_the_runs_with_true_cameras() -> None:
    """They would stop the plan of every run: in these alone nothing could follow it."""
    listed, _ = settings.compared(SHIPPED | {"ba": SHIPPED["ba"] | {"zoom": "yes", "rolling_shutter": "yes"}})
    runs = {run.name: run for run in listed if run.group == "inputs" and run.overrides}
    assert {name for name, run in runs.items() if run.config.ba.zoom == "yes"} == {"true flow", "true masks"}
    shutter = {name for name, run in runs.items() if run.config.ba.rolling_shutter == "yes"}
    assert shutter == {"true intrinsics", "true flow", "true masks"}
    assert runs["true intrinsics"].overrides == {"intrinsics": "truth", "ba.zoom": "auto"}
    both = {"mine": {"both": {"intrinsics": "truth", "ba.zoom": "yes"}}}
    with pytest.raises(InputError, match=r"setting 'both' of 'mine': ba.zoom: expected no or auto where"):
        settings.compared({"sweep": {"runs": both}})


def test_the_sweep_runs_the_groups_that_are_asked_for() -> None:
    sweep = {"presets": ["fast"], "knobs": {"rounds": [1]}, "runs": {"a": {"one": {"ba.seed": 1}}, "b": None}}
    for groups, names in (
        ("all", ["fast", "rounds=1", "rounds=4", "one"]),
        (["a", "b"], ["one"]),
        (["presets"], ["fast"]),
    ):
        assert [s.name for s in settings.compared({"sweep": sweep | {"groups": groups}})[0]] == names
    with pytest.raises(InputError, match=r"sweep.groups: expected .*presets, knobs, a, b.*'c'"):
        settings.compared({"sweep": sweep | {"groups": ["c"]}})
    with pytest.raises(InputError, match=r"sweep.groups: expected .* a list of at least 1, found \[\]"):
        settings.compared({"sweep": sweep | {"groups": []}})


def test_averages_are_those_found_by_hand() -> None:
    rows = [
        *scene("a", cpu_s=(50.0, 100.0, 40.0), psnr_db=(30.0, 30.5, 28.0), ate_percent=(0.2, 0.1, 0.4)),
        *scene("b", cpu_s=(90.0, 200.0, 60.0), ate_percent=(0.3, 0.6, 0.9), psnr_dynamic_db=(None, None, None)),
        *scene("c", status=("ok", "ok", "partial"), ate_percent=(0.1, 0.1, 9.0)),
        *scene("not finished")[:2],
    ]
    scenes = priced.scenes_of(rows)
    assert [found.sequence for found in scenes] == ["a", "b", "c"]
    decided, everything, nothing = priced.means(scenes, ["cpu_s", "ate_percent", "psnr_db", "psnr_dynamic_db"])
    assert decided["cpu_s"] == pytest.approx((50 + 90 + 60) / 3)
    assert (decided["ate_percent"], everything["ate_percent"], nothing["ate_percent"]) == pytest.approx(
        (0.25, 0.35, 0.65)
    )
    assert (everything["psnr_db"], nothing["psnr_dynamic_db"]) == pytest.approx((90.5 / 3, 18.0))
    close, spent, better = (found.words() for found in priced.statements(scenes))
    # ATE twice, half and once that of all effects: 1 as a geometric mean.
    assert "5% ATE of everything on: no; on 2 of 3 scenes, not on a (-0.50 dB, ATE +100 %); " in close
    assert close.endswith("on average -0.17 dB, ATE +0 % on 3 with a path.")
    assert "averaged over the scenes: yes; 52% (45% to 60%), and 50% of the sum." in spent
    assert better.startswith("Never worse than everything off: yes; on 3 of 3 scenes; on average +0.67 dB, ATE -59 %")
    averaged = priced_report.scene_table(scenes).rows[-3:]
    assert [(row["sequence"], row["setting"]) for row in averaged] == [("mean of 3", name) for name in priced.SETTINGS]


def test_each_goal_is_missed_by_what_it_is_about() -> None:
    assert goals(scene("a")) == [True, True, True]
    assert goals(scene("a", psnr_db=(29.89, 30.0, 20.0))) == [False, True, True]
    assert goals(scene("a", psnr_db=(29.91, 30.0, 20.0), ate_percent=(1.04, 1.0, 2.0))) == [True, True, True]
    assert goals(scene("a", ate_percent=(1.06, 1.0, 2.0))) == [False, True, True]
    assert goals(scene("a", cpu_s=(61.0, 100.0, 1.0))) == [True, False, True]
    assert goals(scene("a", cpu_s=(70.0, 100.0, 1.0)), scene("b", cpu_s=(50.0, 100.0, 1.0))) == [True, True, True]
    assert goals(scene("a"), scene("b", psnr_db=(30.0, 30.0, 30.02))) == [True, True, False]
    assert goals(scene("a", ate_percent=(1.0, 1.0, 0.98))) == [True, True, False]
    assert goals(scene("a", psnr_db=(99.0, 30.0, 20.0), ate_percent=(0.1, 1.0, 2.0))) == [True, True, True]


def test_a_path_that_fails_is_worse_than_any_and_an_undefined_error_decides_nothing() -> None:
    failed, straight = ("failed", "ok", "ok"), (None, None, None)
    assert goals(scene("a", status=failed)) == [False, True, False]
    assert goals(scene("a", status=("ok", "partial", "failed"))) == [True, True, True]
    assert goals(scene("a", status=("failed", "failed", "failed"))) == [True, True, True]
    assert goals(scene("a", ate_percent=straight)) == [True, True, True]
    lost = priced.scenes_of(scene("a", status=failed))[0]
    assert priced.against(lost.decided, lost.all).ate_ratio == math.inf
    sentence, (figure,), tables = priced_report.priced_part(
        scene("a", status=failed) + scene("b", ate_percent=straight)
    )
    assert "not on a (+0.00 dB, no complete path)" in sentence
    assert "a 60%, +0.00 dB, no complete path and 40%" in figure.alt
    assert [len(table.rows) for table in tables] == [6 + 3, 2]
    assert priced_report.priced_part(comparison_tables.cost_rows()) == ("", [], [])


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep over a finished scene, whose run with all effects took twice the time, and one that has yet to begin."""
    folder = finished_run.finish(tmp_path_factory.mktemp("priced"), "wall")
    every = list(effects().values())
    runs = [compared_runs.swept_run(every, run, name) for name in ("wall", "later") for run in every[1:]]
    write_json(folder.parent / "sweep/runs.json", {"runs": runs})
    for stage in ("inspect", "colmap", "flow", "lens", "motion", "segment", "ba", "scene", "control", "render"):
        shutil.copy(folder / "stats/gaussians.json", folder / f"stats/{stage}.json")
    for run in runs[1:3]:
        for source in (path for path in compared_runs.needed_files(runs[0]) if not path.startswith("wall/stats")):
            target = folder.parent / source.replace("wall/", f"{Path(run['scene']).parent}/", 1)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(folder.parent / source, target)
    times = folder.parent / runs[1]["scores"] / "time.parquet"
    rows = [row | {"cpu_s": 2 * row["cpu_s"]} for row in read_rows(times)]
    write_rows(times, rows, list(rows[0]), {})
    return folder.parent


def test_the_page_is_written_from_what_is_finished(results: Path, tmp_path: Path) -> None:
    readme = tmp_path / "README.md"
    readme.write_text(f"before\n{page.MARKS[0]}\nold\n{page.MARKS[1]}\nafter\n")
    paths = tmp_path / "docs/priced.md", tmp_path / "docs/priced.png"
    options = ResultsOptions(command="make priced")
    assert page.main(results, *paths, options, readme=readme) == "1 sequences, 1 unfinished"
    text = paths[0].read_text()
    assert "Without results of all three settings, and left out: later." in text
    assert "Made by other code than that of this commit: wall." in text
    assert "averaged over the scenes: yes; 50% (50% to 50%)" in text
    assert "](priced.png)" in text
    assert "](docs/priced.png)" in readme.read_text()
    assert readme.read_text().startswith("before\n")
    assert readme.read_text().endswith("after\n")
    assert paths[1].read_bytes().startswith(b"\x89PNG")
    listed = json.loads((results / "sweep/runs.json").read_text())["runs"]
    write_json(tmp_path / "sweep/runs.json", {"runs": listed})
    with pytest.raises(InputError, match="run `make priced`"):
        page.main(tmp_path, *paths, options)
