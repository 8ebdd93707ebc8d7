"""Given cameras in the workflow: the jobs that are left, what `ba` reads, and what is refused before any job."""

import re
from pathlib import Path

import numpy as np
import pytest
from conftest import run_snakemake, write_frames
from test_workflow import planned, with_options

from stages.configuration import config as configuration
from stages.configuration import given_inputs, settings
from stages.shared.artifacts import write_json, write_table
from stages.shared.errors import InputError
from stages.shared.run_inputs import read_run_inputs
from stages.shared.sequences import check_sequence


def test_poses_that_are_held_fixed_need_two_rounds_and_are_an_input(repo_copy: Path) -> None:
    for name in ("one", "two"):
        write_frames(repo_copy / "clips" / name)
        (repo_copy / f"{name}.tum").write_text("".join(f"{k} 0 0 {k} 0 0 0 1\n" for k in range(1, 10)))
    mine = "{dataset: clips, intrinsics: 100, ba: {poses_from: '{sequence}.tum'}}"
    result = run_snakemake(repo_copy, "poses", "-p", *with_options(repo_copy, mine))
    assert planned(result) == {"inspect", "flow", "lens", "motion", "segment", "ba", "poses"}
    counts = dict(re.findall(r"^(\w+) +(\d+)$", result.stdout, re.MULTILINE))
    assert {name: int(counts[name]) for name in ("motion", "segment", "ba")} == {"motion": 2, "segment": 2, "ba": 4}
    assert result.stdout.count("--rolling-shutter auto --poses-from '{sequence}.tum' --poses-as fixed") == 4
    (repo_copy / "two.tum").unlink()
    refused = run_snakemake(repo_copy, "poses", *with_options(repo_copy, mine))
    assert refused.returncode == 2
    assert refused.stderr.splitlines()[-1] == (
        "two.tum: expected an existing file or folder, found nothing there; correct the path in your config file"
    )


def test_truth_that_the_simulator_will_write_is_there(repo_copy: Path) -> None:
    mine = "{flow: {source: truth}, segment: {source: truth}, ba: {poses_from: truth, depth_from: truth}}"
    result = run_snakemake(repo_copy, "poses", *with_options(repo_copy, mine))
    assert planned(result) == {"simulate", "inspect", "flow", "lens", "segment", "ba", "poses"}


@pytest.mark.parametrize(
    ("options", "rounds", "first_masks"),
    [
        ({}, 2, "none"),
        ({"preset": "accurate"}, 2, "none"),
        ({"rounds": 3, "first_masks": "flow"}, 3, "flow"),
        ({"ba": {"poses_as": "start"}}, 4, "flow"),
        ({"segment": {"source": "masks"}}, 1, "flow"),
        ({"segment": {"source": "masks"}, "ba": {"poses_as": "start"}}, 4, "flow"),
    ],
)
def test_rounds_under_given_poses(options: dict, rounds: int, first_masks: str) -> None:
    """One's own number of rounds wins, as over a preset."""
    raw = options | {"ba": {"poses_from": "truth"} | options.get("ba", {})}
    config = configuration.load(raw, raw)
    assert (config.rounds, config.first_masks) == (rounds, first_masks)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"intrinsics": "1200", "poses_from": "estimate"}, "given intrinsics"),
        ({"intrinsics": "truth", "poses_from": "a.tum"}, "true intrinsics, given poses"),
        ({"intrinsics": "estimate", "poses_from": "truth"}, "true intrinsics, true poses"),
        ({"intrinsics": "estimate", "poses_from": "estimate"}, None),
    ],
)
def test_what_a_run_was_given_is_named(tmp_path: Path, options: dict, named: str | None) -> None:
    write_table(tmp_path / "flow.parquet", {"source": np.zeros(1)}, {"source": "dis"})
    write_table(tmp_path / "poses.parquet", {"frame": np.zeros(1)}, {"options": options | {"depth_from": "estimate"}})
    write_json(tmp_path / "masks" / "masks.json", {"options": {"source": "refined"}})
    assert read_run_inputs(tmp_path / "flow.parquet", [tmp_path / "masks"], [tmp_path / "poses.parquet"]).taken == named


def test_one_file_for_several_sequences_is_refused(tmp_path: Path) -> None:
    cameras = tmp_path / "cameras.txt"
    cameras.write_text("1 PINHOLE 64 48 50 50 32 24")
    one, two = (check_sequence(name, write_frames(tmp_path / name)) for name in ("one", "two"))
    setting = settings.configured({"intrinsics": str(cameras)})
    given_inputs.check([(setting, [one])])
    expected = r"the configuration: intrinsics: expected \{sequence\} in the path.* names of 2 sequences"
    with pytest.raises(InputError, match=expected):
        given_inputs.check([(setting, [one, two])])
    given_inputs.check([(settings.configured({"intrinsics": 60}), [one, two])])
    shots_of_one = {"one": Path("clip.mp4"), "two": Path("clip.mp4")}
    given_inputs.check([(setting, [one, two])], shots_of_one)
    with pytest.raises(InputError, match=expected):
        given_inputs.check([(setting, [one, two])], shots_of_one | {"two": Path("other.mp4")})


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"intrinsics": "exif"}, "expected EXIF data"),
        ({"intrinsics": "5"}, "^the configuration: intrinsics: expected a focal length of"),
        ({"ba": {"intrinsics": "5"}}, "^the configuration: ba.intrinsics: expected a focal length of"),
        ({"ba": {"poses_from": "all.tum"}}, "expected intrinsics for poses that are held fixed"),
        ({"intrinsics": "60", "ba": {"poses_from": "half.tum"}}, "expected a pose for each of the"),
        ({"intrinsics": "60", "ba": {"poses_from": "all.tum"}}, None),
        ({"ba": {"poses_from": "all.tum", "poses_as": "start"}}, None),
    ],
)
def test_cameras_that_cannot_be_right_are_refused_before_any_job(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict, expected: str | None
) -> None:
    """And not after the flow of all frames."""
    monkeypatch.chdir(tmp_path)
    one = check_sequence("one", write_frames(tmp_path / "one"))
    lines = [f"{number} 0 0 {number} 0 0 0 1\n" for number in one.numbers]
    Path("all.tum").write_text("".join(lines))
    Path("half.tum").write_text("".join(lines[::2]))
    runs = [(settings.configured(options), [one])]
    if expected is None:
        given_inputs.check(runs)
    else:
        with pytest.raises(InputError, match=expected):
            given_inputs.check(runs)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"intrinsics": "no.txt"}, "intrinsics: expected a path that exists, found 'no.txt'; correct 'intrinsics'"),
        ({"segment": {"evidence": "no"}}, "segment.evidence: expected a path that exists, found 'no'; correct"),
    ],
)
def test_an_option_that_allows_no_words_beside_a_path_says_so(options: dict, said: str) -> None:
    """And names the key that the user wrote."""
    with pytest.raises(InputError) as refused:
        given_inputs.check([(settings.configured(options), [])])
    assert str(refused.value).startswith(f"the configuration: {said}")


def test_a_rewritten_camera_file_is_noticed(tmp_path: Path) -> None:
    cameras = tmp_path / "cameras.txt"
    cameras.write_text("1 PINHOLE 64 48 50 50 32 24")
    one = check_sequence("one", write_frames(tmp_path / "one"))
    config = configuration.load({"intrinsics": str(cameras)})
    before = given_inputs.digest(config, "ba", one)
    cameras.write_text("1 PINHOLE 64 48 55 55 32 24 ")
    assert given_inputs.digest(config, "ba", one) != before
    assert given_inputs.digest(config, "flow", one) == ""


@pytest.mark.parametrize(
    "given",
    [
        {"intrinsics": "1200"},
        {"ba": {"intrinsics": "exif"}},
        {"ba": {"poses_from": "a.tum"}},
        {"ba": {"depth_from": "depth"}},
        {"segment": {"source": "masks"}},
        {"segment": {"evidence": "masks"}},
    ],
)
def test_frames_are_not_undistorted_under_what_was_made_of_them(given: dict) -> None:
    """Undistorted frames have another size and another K."""
    assert configuration.load(given).lens.distortion == "no"
    with pytest.raises(InputError, match=r"lens\.distortion: expected no or auto where"):
        configuration.load(given | {"lens": {"distortion": "yes"}})


@pytest.mark.parametrize(
    ("given", "option", "has_room"),
    [
        ({"intrinsics": "1200"}, "zoom", False),
        ({"intrinsics": "truth"}, "zoom", False),
        ({"intrinsics": "1200"}, "rolling_shutter", True),
        ({"ba": {"poses_from": "a.tum"}}, "zoom", False),
        ({"ba": {"poses_from": "a.tum"}}, "rolling_shutter", False),
        ({"ba": {"poses_from": "truth"}}, "rolling_shutter", False),
        ({"ba": {"poses_from": "a.tum", "poses_as": "start"}}, "zoom", True),
        ({"ba": {"poses_from": "a.tum", "poses_as": "start"}}, "rolling_shutter", True),
    ],
)
def test_an_effect_of_the_camera_that_nothing_would_estimate_is_refused(
    given: dict, option: str, has_room: bool
) -> None:
    """It would be ignored. Without `yes` nothing is said."""
    for word, refused in (("yes", not has_room), ("auto", False), ("no", False)):
        raw = given | {"ba": given.get("ba", {}) | {option: word}}
        if refused:
            with pytest.raises(InputError, match=rf"ba\.{option}: expected no or auto where .* given: .*'yes'; leave"):
                configuration.load(raw)
        else:
            assert getattr(configuration.load(raw).ba, option) == word


@pytest.mark.parametrize("given", [{}, {"intrinsics": "truth"}, {"flow": {"source": "flows"}}])
def test_truth_and_flow_are_carried_over_to_undistorted_frames(given: dict) -> None:
    assert configuration.load(given).lens.distortion == "auto"
