"""What Snakemake would do, read from dry-run reasons: targets, reruns, memory, working directories."""

import re
import shlex
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from conftest import copy_sources, run_snakemake, write_frames

EVERY_RULE = {
    *("simulate", "inspect", "flow", "lens", "motion", "segment", "ba", "scene", "control", "gaussians", "render"),
    *("viewer", "colmap", "evaluate", "report", "all"),
}
AFTER_FLOW = EVERY_RULE - {"simulate", "inspect", "flow", "colmap"}
AFTER_SCENE = AFTER_FLOW - {"lens", "motion", "segment", "ba", "scene"}
SWEEP = {
    "presets": ["fast"],
    "knobs": {"rounds": [1]},
    "runs": {"claims": {"static": {"scene.dynamic": "no"}}, "baselines": {"both": {"colmap.upsample_masked": [1]}}},
}
SCALING = {"axes": {"control points": {"control.control_points": [8]}}}
COLLECTED = {"collect_sweep", "report", "sweep"}


def planned(result: subprocess.CompletedProcess[str]) -> set[str]:
    """The rules that a dry run would execute."""
    assert result.returncode == 0, result.stderr
    return set(re.findall(r"^ *(?:local)?rule (\w+):", result.stdout + result.stderr, re.MULTILINE))


@pytest.fixture(scope="module")
def everything_done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A working folder in which Snakemake believes that everything has run (empty outputs, recorded params)."""
    folder = with_comparisons(copy_sources(tmp_path_factory.mktemp("done")))
    write_outputs(folder, run_snakemake(folder, "-n", "sweep", "scaling"))
    for arguments in (["sweep", "scaling", "-F"], []):  # last the plain run: its report reads what the others left
        assert run_snakemake(folder, *arguments, "--touch").returncode == 0
    assert planned(run_snakemake(folder, "-n")) == set()
    return folder


def write_outputs(folder: Path, plan: subprocess.CompletedProcess[str]) -> None:
    """Empty files and folders for all that a dry run would make."""
    for line in re.findall(r"^ +output: (.*)$", plan.stdout + plan.stderr, re.MULTILINE):
        for name in line.split(", "):
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch() if path.suffix else path.mkdir(exist_ok=True)


@pytest.fixture
def finished(everything_done: Path) -> Iterator[Path]:
    """The finished folder, to edit freely: its sources are restored afterwards."""
    yield everything_done
    with_comparisons(copy_sources(everything_done))


def with_comparisons(folder: Path) -> Path:
    """The folder with a shorter sweep and scaling than the shipped ones."""
    path = folder / "config.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | {"sweep": SWEEP, "scaling": SCALING}))
    return folder


def with_options(folder: Path, text: str) -> list[str]:
    """Arguments of a dry run with overrides."""
    (folder / "mine.yaml").write_text(text)
    return ["-n", "--configfile", "config.yaml", "mine.yaml"]


def test_plain_snakemake_plans_every_stage(repo_copy: Path) -> None:
    plan = run_snakemake(repo_copy, "-n")
    assert planned(plan) == EVERY_RULE
    assert re.search(r"^This run writes about \d+ MB; [\d.]+ .B are free\.$", plan.stdout + plan.stderr, re.MULTILINE)


@pytest.mark.parametrize(
    ("formats", "besides"),
    [
        ("[colmap, npz, depth_png, masks]", set()),
        ("[spz, video]", {"scene", "control", "gaussians", "render"}),
    ],
)
def test_an_export_runs_what_its_formats_need(repo_copy: Path, formats: str, besides: set[str]) -> None:
    poses = {"simulate", "inspect", "flow", "lens", "motion", "segment", "ba", "export_sequence", "export"}
    plan = run_snakemake(repo_copy, "-n", "export", "--config", f"export={{formats: {formats}}}")
    assert planned(plan) == poses | besides


@pytest.mark.parametrize(
    ("override", "rerun"),
    [
        ("flow: {max_side_px: 300}", AFTER_FLOW | {"flow"}),
        ("control: {control_points: 77}", AFTER_SCENE),
        ("gaussians: {steps: 33}", AFTER_SCENE - {"control"}),
        ("holdout_every: 7", AFTER_SCENE | {"scene"}),
        ("simulate: {seed: 5}", EVERY_RULE),
        ("colmap: {seed: 5}", {"colmap", "evaluate", "report", "all"}),
        ("colmap: {upsample_masked: [1]}", {"colmap", "colmap_masked", "evaluate", "report", "all"}),
        ("report: {title: Mine}", {"report", "all"}),
        ("flow: {}", set()),
    ],
)
def test_an_option_reruns_its_readers_and_their_dependents(finished: Path, override: str, rerun: set[str]) -> None:
    assert planned(run_snakemake(finished, *with_options(finished, override))) == rerun


def test_a_number_as_text_equals_the_number(finished: Path) -> None:
    assert planned(run_snakemake(finished, *with_options(finished, 'holdout_every: "8"'))) == set()


def test_a_comment_or_docstring_reruns_nothing(finished: Path) -> None:
    for name in ("stages/shared/cameras.py", "stages/report/__main__.py"):
        path = finished / name
        path.write_text(path.read_text().replace('"""', '"""Other words. ', 1) + "\n# a comment\n")
    assert planned(run_snakemake(finished, "-n")) == set()


def test_a_changed_function_reruns_its_users_only(finished: Path) -> None:
    path = finished / "stages/report/__main__.py"
    path.write_text(path.read_text() + "\nNEW = 1\n")
    assert planned(run_snakemake(finished, "-n")) == {"report", "all"}
    path = finished / "stages/shared/alignment.py"
    path.write_text(path.read_text() + "\nNEW = 1\n")
    assert planned(run_snakemake(finished, "-n")) == {"render", "evaluate", "report", "all"}


def test_a_changed_script_of_the_page_makes_the_pages_again(finished: Path) -> None:
    path = finished / "stages/viewer/templates/order.js"
    path.write_text(path.read_text() + "// changed")
    assert planned(run_snakemake(finished, "-n")) == {"viewer", "report", "all"}


def test_forced_rule_and_until(finished: Path) -> None:
    assert planned(run_snakemake(finished, "-n", "-R", "evaluate")) == {"evaluate", "report", "all"}
    forced = planned(run_snakemake(finished, "-n", "-R", "segment"))
    assert forced == AFTER_FLOW - {"lens"}
    assert planned(run_snakemake(finished, "-n", "-F", "--until", "ba")) == {
        *("simulate", "inspect", "flow", "lens", "motion", "segment", "ba")
    }


@pytest.mark.parametrize(
    ("target", "last"),
    [("poses", "ba"), ("masks", "segment"), ("splats", "gaussians"), ("scenes", "viewer"), ("report", "report")],
)
def test_targets_stop_at_their_stage(repo_copy: Path, target: str, last: str) -> None:
    rules = planned(run_snakemake(repo_copy, "-n", target))
    assert last in rules
    assert ("evaluate" in rules) == (target == "report")


def test_another_working_directory(repo_copy: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    assert planned(run_snakemake(repo_copy, "-n", "--directory", str(elsewhere))) == EVERY_RULE


def test_sequences_of_a_folder_with_memory_by_pixels(repo_copy: Path) -> None:
    folder = repo_copy / "simulated"  # a folder's name says nothing: these frames are there already
    write_frames(folder / "small", 4, (48, 64))
    write_frames(folder / "large", 8, (480, 640))
    result = run_snakemake(repo_copy, "poses", *with_options(repo_copy, f"dataset: {folder}"))
    jobs = re.split(r"^ *(?=rule \w+:)", result.stdout + result.stderr, flags=re.MULTILINE)
    flow = {name: job for job in jobs for name in ("small", "large") if job.startswith("rule flow") and name in job}
    memory = {name: int(re.search(r"mem_mb=(\d+)", job).group(1)) for name, job in flow.items()}  # type: ignore[union-attr]
    assert memory["large"] > memory["small"] > 0
    assert all("threads: " in job for job in flow.values())
    assert "simulate" not in planned(result)


def test_truth_that_appears_later_is_noticed(repo_copy: Path) -> None:
    training = repo_copy / "sintel" / "training"
    write_frames(training / "final" / "clip")
    options = ["--configfile", "config.yaml", str(repo_copy / "mine.yaml")]
    (repo_copy / "mine.yaml").write_text("dataset: sintel")
    write_outputs(repo_copy, run_snakemake(repo_copy, "-n", *options))
    assert run_snakemake(repo_copy, "--touch", *options).returncode == 0
    assert planned(run_snakemake(repo_copy, "-n", *options)) == set()
    (training / "depth" / "clip").mkdir(parents=True)
    assert {"inspect", "evaluate", "report"} <= planned(run_snakemake(repo_copy, "-n", *options))
    assert run_snakemake(repo_copy, "--touch", *options).returncode == 0
    assert planned(run_snakemake(repo_copy, "-n", *options)) == set()
    (training / "depth" / "clip" / "frame_0001.dpt").touch()
    assert {"inspect", "evaluate", "report"} <= planned(run_snakemake(repo_copy, "-n", *options))


def test_a_frame_that_is_rewritten_is_noticed(repo_copy: Path) -> None:
    """The time of its folder stays as it was."""
    clip = write_frames(repo_copy / "clips" / "clip")
    options = with_options(repo_copy, "dataset: clips")[1:]
    write_outputs(repo_copy, run_snakemake(repo_copy, "-n", *options))
    assert run_snakemake(repo_copy, "-F", "--touch", *options).returncode == 0
    assert planned(run_snakemake(repo_copy, "-n", *options)) == set()
    before = clip.stat().st_mtime_ns
    (clip / "frame_0002.png").write_bytes((clip / "frame_0003.png").read_bytes())
    assert clip.stat().st_mtime_ns == before
    assert {"inspect", "flow", "report"} <= planned(run_snakemake(repo_copy, "-n", *options))


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("results/simulated/nosuch/ba/poses.parquet", "no sequence of this configuration is called 'nosuch'"),
        ("results/simulated/demo/settings/mine/scene.json", "no setting of this configuration is called 'mine'"),
    ],
)
def test_a_target_of_unknown_name_says_so(repo_copy: Path, target: str, message: str) -> None:
    result = run_snakemake(repo_copy, "-n", target)
    assert result.returncode != 0
    assert message in result.stdout + result.stderr


@pytest.mark.parametrize(
    ("override", "rules"),
    [
        ("device: cpu", set()),
        ("device: cuda", {"gaussians", "render"}),
        ("{device: cpu, render: {device: cuda}}", {"render"}),
    ],
)
def test_jobs_ask_for_a_gpu_only_where_they_use_one(repo_copy: Path, override: str, rules: set[str]) -> None:
    result = run_snakemake(repo_copy, *with_options(repo_copy, override))
    jobs = re.split(r"^ *(?=(?:local)?rule \w+:)", result.stdout + result.stderr, flags=re.MULTILINE)
    asking = {job.partition(":")[0].removeprefix("rule ") for job in jobs if re.search(r"resources: .*\bgpu=", job)}
    assert asking == rules


def test_names_with_spaces_stay_one_word(repo_copy: Path) -> None:
    """Or worse: a folder called `a; b` would run b."""
    write_frames(repo_copy / "my clips" / "take 1; two", 4, (48, 64))
    options = with_options(repo_copy, 'dataset: "my clips"')
    plan = run_snakemake(repo_copy, "-p", *options)
    commands = [shlex.split(line) for line in plan.stdout.splitlines() if "python -m stages" in line]
    assert len(commands) == len(EVERY_RULE - {"simulate", "all"}) + 3 * len(("motion", "segment", "ba"))
    for words in commands:
        assert "" not in words
        assert any("my clips/take 1; two" in word for word in words)
        assert not any(word.endswith("/my") for word in words)


def test_scenes_all_means_the_whole_scene_library(repo_copy: Path) -> None:
    scenes = list((repo_copy / "stages/simulate/scenes").glob("*.yaml"))
    result = run_snakemake(repo_copy, "poses", *with_options(repo_copy, "scenes: all"))
    count = re.search(r"^simulate +(\d+)$", result.stdout + result.stderr, re.MULTILINE)
    assert count is not None
    assert int(count.group(1)) == len(scenes)


def test_a_sweep_runs_only_what_differs(repo_copy: Path) -> None:
    result = run_snakemake(with_comparisons(repo_copy), "-n", "sweep")
    counts = dict(re.findall(r"^(\w+) +(\d+)$", result.stdout, re.MULTILINE))
    # Configured, fast, one round, static, other COLMAPs. The one round is the first of the configured run; fast has
    # flow of its own, and no masks in its first round; other COLMAPs are evaluated apart and share all else.
    expected = {"simulate": 1, "inspect": 1, "colmap": 2, "colmap_masked": 1, "flow": 2, "lens": 2, "motion": 7}
    expected |= {"segment": 7}
    expected |= {"ba": 8, "scene": 4, "control": 4, "gaussians": 4, "render": 4, "evaluate": 5, "collect_sweep": 1}
    assert {name: int(counts[name]) for name in expected} == expected
    assert "collect_scaling" not in counts


@pytest.mark.parametrize(
    ("target", "override", "rerun"),
    [
        ("sweep", "gaussians: {steps: 33}", {"gaussians", "render", "viewer", "evaluate", *COLLECTED}),
        ("sweep", "colmap: {seed: 5}", {"colmap", "colmap_masked", "evaluate", *COLLECTED}),
        ("scaling", "control: {steps: 3}", {*AFTER_SCENE, "collect_scaling", "scaling"} - {"all"}),
        ("all", "sweep: {knobs: {rounds: [3]}}", set()),
    ],
)
def test_an_option_reruns_its_readers_under_every_setting(
    finished: Path, target: str, override: str, rerun: set[str]
) -> None:
    assert planned(run_snakemake(finished, target, *with_options(finished, override))) == rerun


def test_a_wrong_setting_stops_at_once(repo_copy: Path) -> None:
    override = "sweep: {runs: {mine: {finer: {flow.finest_scal: 0}}}}"
    result = run_snakemake(repo_copy, *with_options(repo_copy, override))
    assert result.returncode == 2
    assert "setting 'finer' of 'mine'" in result.stderr
    assert "did you mean 'finest_scale'" in result.stderr
