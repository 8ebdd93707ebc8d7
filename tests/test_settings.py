"""Settings and presets: which value wins, which stages two runs share, and what is refused."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from conftest import REPO, write_frames

from stages.configuration import config as configuration
from stages.configuration import datasets, plan, required_truth, settings, training_frames
from stages.configuration.presets import PRESETS, override, value_of
from stages.shared import sintel
from stages.shared.cameras import centred_intrinsics
from stages.shared.errors import InputError
from stages.shared.sequences import TRUTH_KINDS, Sequence, list_sequence

SWEEP: dict[str, Any] = {
    "presets": ["fast", "balanced"],
    "knobs": {"ba.stride_px": [4, 16], "rounds": [1, 5], "gaussians.steps": [5]},
    "runs": {"claims": {"static only": {"scene.dynamic": "no"}, "left out": None}, "none": None},
}
WITHOUT_FIRST = {"first_masks": "none", "rounds": 2}


def homes(stage: str, number: int = 0, **raw: Any) -> dict[str, str]:
    """Where the results of a stage lie, by name of the setting; of the last round unless one is given."""
    raw = {"sweep": SWEEP} | raw
    every = [settings.configured(raw), *settings.compared(raw)[0]]
    ran = [s for s in every[1:] if not number or number in plan.rounds_of(s, stage)]
    return {s.name: plan.find_home(every, s, stage, number or s.config.rounds) for s in ran}


def test_a_preset_sets_what_the_user_did_not() -> None:
    fast = PRESETS["fast"]
    plain = configuration.load({"preset": "fast"})
    assert {name: value_of(plain.model_dump(), name) for name in fast} == fast
    changed = configuration.load({"preset": "fast", "gaussians": {"steps": 77}})
    assert changed.gaussians.steps == 77
    assert changed.gaussians.stride_px == fast["gaussians.stride_px"]


def test_a_default_that_the_user_wrote_wins_over_the_preset() -> None:
    shipped = yaml.safe_load((REPO / "config.yaml").read_text()) | {"preset": "fast"}
    default = configuration.Config().gaussians.steps
    assert configuration.load(shipped).gaussians.steps == PRESETS["fast"]["gaussians.steps"] != default
    mine = {"gaussians": {"steps": default}}
    assert configuration.load(shipped, mine).gaussians.steps == default


def test_every_preset_is_valid_and_moves_something() -> None:
    balanced = configuration.Config()
    for name in PRESETS:
        config = configuration.load({"preset": name})
        assert (config.model_copy(update={"preset": "balanced"}) == balanced) == (name == "balanced")


def test_overrides_leave_the_original_alone() -> None:
    raw: dict[str, Any] = {"flow": None, "ba": {"seed": 1}}
    assert override(raw, {"flow.finest_scale": 1, "ba.stride_px": 4, "rounds": 3}) == {
        "flow": {"finest_scale": 1},
        "ba": {"seed": 1, "stride_px": 4},
        "rounds": 3,
    }
    assert raw == {"flow": None, "ba": {"seed": 1}}


def test_stages_before_the_first_difference_are_shared() -> None:
    assert homes("flow") == dict.fromkeys(homes("flow"), "") | {"fast": "settings/presets-fast/"}
    assert homes("ba")["static only"] == ""
    assert homes("scene")["static only"] == "settings/claims-static_only/"
    assert homes("control")["gaussians.steps=5"] == ""
    assert homes("gaussians")["gaussians.steps=5"] == "settings/gaussians.steps=5/"
    assert set(homes("colmap").values()) == {""}


def test_the_configured_value_stands_in_every_series_and_is_not_run_again() -> None:
    evaluated = homes("evaluate")
    assert {name for name, home in evaluated.items() if home == ""} == {
        *("balanced", "ba.stride_px=8", "rounds=4", "gaussians.steps=1000")
    }
    assert "left out" not in evaluated


def test_rounds_in_common_are_shared() -> None:
    assert homes("ba", 1)["rounds=1"] == "round1/"
    assert homes("ba", 1)["rounds=5"] == "round1/"
    assert homes("ba", 3)["rounds=5"] == "round3/"
    assert homes("ba", 4)["rounds=5"] == ""  # the last round of the configured run has no prefix
    assert homes("ba", 5)["rounds=5"] == "settings/rounds=5/"
    assert homes("scene")["rounds=1"] == "settings/rounds=1/"
    assert homes("motion", 1)["ba.stride_px=4"] == "round1/"  # the first prior knows no adjustment
    assert homes("motion", 2)["ba.stride_px=4"] == "settings/ba.stride_px=4/round2/"


def test_the_first_round_may_go_without_masks() -> None:
    """Then its poses depend on flow alone: no change of masks is a reason to find them again."""
    runs = {"a": {"none": WITHOUT_FIRST, "smooth": WITHOUT_FIRST | {"segment.smoothness": 5}}}
    (plain, smooth), _ = settings.compared({"sweep": {"runs": runs, "presets": [], "knobs": {}}})
    assert list(plan.rounds_of(plain, "motion")) == list(plan.rounds_of(plain, "segment")) == [2]
    assert list(plan.rounds_of(plain, "ba")) == [1, 2]
    every = [plain, smooth]
    assert plan.find_home(every, smooth, "ba", 1) == "settings/a-none/round1/"
    assert plan.find_home(every, smooth, "motion", 2) == "settings/a-none/"
    assert plan.find_home(every, smooth, "segment", 2) == "settings/a-smooth/"
    with pytest.raises(ValueError, match="not in"):
        plan.find_home(every, smooth, "segment", 1)


def test_a_single_round_has_masks_whatever_the_first_does() -> None:
    setting = settings.configured({"first_masks": "none", "rounds": 1})
    assert list(plan.rounds_of(setting, "segment")) == [1]


def test_two_settings_share_what_differs_from_the_configured_run() -> None:
    runs = {"a": {"one": {"ba.stride_px": 4}, "two": {"ba.stride_px": 4, "gaussians.steps": 5}}}
    found = homes("ba", sweep={"runs": runs})
    assert found == {"one": "settings/a-one/", "two": "settings/a-one/"}
    assert homes("gaussians", sweep={"runs": runs})["two"] == "settings/a-two/"


def test_a_preset_in_the_sweep_keeps_the_users_own_values() -> None:
    raw = {"gaussians": {"steps": 1000}, "sweep": {"presets": ["fast"]}}
    (with_default,), _ = settings.compared(raw, {"gaussians": {"steps": 1000}})
    assert with_default.config.gaussians.steps == 1000
    assert with_default.config.flow.max_side_px == PRESETS["fast"]["flow.max_side_px"]


@pytest.mark.parametrize(
    ("sweep", "words"),
    [
        ({"knobs": {"flow.finest_scal": [1]}}, "did you mean 'finest_scale'"),
        ({"knobs": {"flow.finest_scale": [9]}}, "flow.finest_scale.*less than or equal to 3"),
        ({"knobs": {"scenes": [["demo"]]}}, "expected an option of inspect, .* found 'scenes'"),
        ({"knobs": {"colmap.window": [5]}}, "expected an option of inspect, .* found 'colmap.window'"),
        ({"runs": {"g": {"n": {"steps": 3}}}}, "setting 'n' of 'g'.*write it as section.option"),
        ({"runs": {"g": {"a b": {"seed": 1}, "a_b": {"seed": 2}}}}, "names that differ"),
        ({"runs": {"knobs": {"n": {"seed": 1}}}}, "sweep.runs.knobs: expected another name than presets and knobs"),
        ({"runs": {"presets": {"n": {"seed": 1}}}}, "sweep.runs.presets: expected another name than presets and knobs"),
        ({"presets": ["quick"]}, "'fast', 'balanced' or 'accurate'"),
    ],
)
def test_a_wrong_setting_is_refused_in_one_line(sweep: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words) as error:
        settings.compared({"sweep": sweep})
    assert "\n" not in str(error.value)


def test_sequences_of_a_comparison() -> None:
    def chosen(value: Any) -> list[str]:
        return settings.choose_sequences(configuration.load({"sweep": {"sequences": value}}).sweep, ["a", "b"])

    assert chosen("first") == ["a"]
    assert chosen("all") == ["a", "b"]
    assert chosen(["b"]) == ["b"]
    with pytest.raises(InputError, match="'c'"):
        chosen(["c"])


@pytest.mark.parametrize("key", ["sequences", "scenes"])
def test_a_run_without_any_sequence_is_refused(key: str) -> None:
    """Every job of it would be left out but the report, which fails without results."""
    with pytest.raises(
        InputError, match=rf"^the configuration: {key}: expected 'all' or at least one name, found \[\]"
    ):
        configuration.load({key: []})


def test_a_setting_that_takes_truth_needs_it() -> None:
    runs = {"inputs": {"masks": {"segment.source": "truth"}, "none": {"segment.source": "none"}}}
    masks, none = settings.compared({"sweep": {"runs": runs}})[0]
    files = {number: Path(f"{number}.png") for number in (1, 2, 3)}
    bare = Sequence("clip", list(files.values()), list(files), 4, 4)
    full = replace(bare, truth={"motion_mask": files})
    gap = replace(bare, truth={"motion_mask": {1: files[1]}})
    assert [required_truth.lacks_truth(masks, s) for s in (bare, full, gap)] == [True, False, True]
    assert not required_truth.lacks_truth(none, bare)


@pytest.mark.parametrize(
    ("option", "kind", "default"),
    [
        ("intrinsics", "camdata_left", "estimate"),
        ("ba.intrinsics", "camdata_left", "estimate"),
        ("flow.source", "flow, depth, camdata_left", "dis"),
        ("segment.source", "motion_mask", "refined"),
        ("ba.poses_from", "camdata_left", "estimate"),
        ("ba.depth_from", "depth", "estimate"),
    ],
)
def test_a_run_that_takes_truth_needs_it_for_every_frame_that_it_uses(
    tmp_path: Path, option: str, kind: str, default: str
) -> None:
    """Of the frames of a clip the first three have truth."""
    clip = list_sequence("clip", write_frames(tmp_path / "final" / "clip"))
    for name in kind.split(", "):
        folder = tmp_path / name / "clip"
        folder.mkdir(parents=True)
        for number in (1, 2, 3):
            path = folder / f"frame_{number:04d}{TRUTH_KINDS[name]}"
            sintel.write_cam(path, np.eye(3), np.eye(3, 4)) if name == "camdata_left" else path.touch()

    def check(**raw: Any) -> None:
        setting = settings.configured(override(raw, {option: "truth"}))
        required_truth.check(setting, {"clip": clip}, {"clip": str(tmp_path / "final" / "clip")})

    check(inspect={"max_frames": 3})
    missing = kind.replace("flow, ", "")
    said = f"{option}: expected {kind} of every frame of 'clip' .* found {missing} missing .* '{option}' to '{default}'"
    with pytest.raises(InputError, match=said):
        check()


def test_a_setting_of_a_sweep_leaves_two_frames_to_train_on() -> None:
    """The configured run does; the setting alone would stop, after flow and adjustment."""
    files = [Path(f"{number}.png") for number in (1, 2, 3)]
    clip = Sequence("clip", files, [1, 2, 3], 4, 4)
    runs = {
        "splits": {"few": {"holdout_every": 2, "holdout_first": 0}, "two": {"holdout_every": 2, "holdout_first": 1}}
    }
    few, two = settings.compared({"sweep": {"runs": runs, "presets": [], "knobs": {}}})[0]
    training_frames.check([(two, [clip])])
    with pytest.raises(InputError, match="'few' of 'splits': holdout_every: expected at least 2 frames"):
        training_frames.check([(two, [clip]), (few, [clip])])


def test_a_setting_that_takes_true_flow_needs_a_lens_without_distortion() -> None:
    """The flow stage refuses the truth of a distorted lens: one such run would cost the sweep its table."""
    runs = {"inputs": {"flow": {"flow.source": "truth"}, "masks": {"segment.source": "truth"}}}
    wanted = settings.compared({"sweep": {"runs": runs, "presets": [], "knobs": {}}})[0]
    files = {number: Path(f"{number}") for number in (1, 2, 3)}
    truth = dict.fromkeys(("flow", "depth", "camdata_left", "motion_mask"), files)
    straight = Sequence("clip", list(files.values()), list(files), 4, 4, truth)
    distorted = replace(straight, truth=truth | {"distortion": files})
    lacking = [[required_truth.lacks_truth(s, sequence) for s in wanted] for sequence in (straight, distorted)]
    assert lacking == [[False, False], [True, False]]
    assert [required_truth.takes_straight_lens(s) for s in wanted] == [True, False]
    simulated = configuration.load({"scenes": ["demo", "wide_playground"]})
    assert [datasets.distorts(simulated, name) for name in simulated.scenes] == [False, True]


def test_a_setting_that_takes_true_cameras_needs_one_focal_length(tmp_path: Path) -> None:
    """The adjustment refuses them where it changes: one such run would cost the sweep its table."""
    runs = {"inputs": {"focal": {"intrinsics": "truth"}, "poses": {"ba.poses_from": "truth"}}}
    wanted = settings.compared({"sweep": {"runs": runs, "presets": [], "knobs": {}}})[0]
    sequences = []
    for name, zoom in (("still", 1.0), ("zooming", 1.02)):
        files = {number: tmp_path / name / f"frame_{number:04d}.cam" for number in (1, 2, 3)}
        for number, path in files.items():
            path.parent.mkdir(exist_ok=True)
            sintel.write_cam(path, centred_intrinsics(90 * zoom**number, 96, 64), np.eye(3, 4))
        sequences.append(Sequence(name, list(files.values()), list(files), 96, 64, {"camdata_left": files}))
    assert [[required_truth.lacks_truth(s, sequence) for s in wanted] for sequence in sequences] == [
        [False] * 2,
        [True] * 2,
    ]
    (tmp_path / "camdata_left").mkdir()
    (tmp_path / "zooming").rename(tmp_path / "camdata_left" / "zooming")
    configured, folders = settings.configured({"intrinsics": "truth"}), {"zooming": str(tmp_path / "final" / "zooming")}
    with pytest.raises(InputError, match="as one shared camera"):
        required_truth.check(configured, {"zooming": sequences[1]}, folders)
    simulated = configuration.load({"scenes": ["demo", "glossy_zoom"]})
    assert [datasets.zooms(simulated, name) for name in simulated.scenes] == [False, True]
