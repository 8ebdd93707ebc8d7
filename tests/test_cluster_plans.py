"""What Snakemake would submit to a cluster, read from dry runs under profiles/slurm."""

import re
from pathlib import Path

import pytest
from conftest import run_snakemake
from test_workflow import EVERY_RULE, with_comparisons


def test_on_a_cluster_short_stages_travel_together_and_settings_apart(repo_copy: Path) -> None:
    pytest.importorskip("snakemake_executor_plugin_slurm")
    result = run_snakemake(with_comparisons(repo_copy), "-n", "sweep", "--profile", "profiles/slurm")
    assert result.returncode == 0, result.stderr
    groups = re.findall(r"Group job (\w+)(.*?)(?=^\S)", result.stdout, re.MULTILINE | re.DOTALL)
    rules = {name: set(re.findall(r"rule (\w+):", text)) for name, text in groups}
    own = {"scene", "control"}  # of settings that share the poses of another
    poses = {"poses": {"simulate", "inspect", "flow", "lens", "motion", "segment", "ba"} | own, "poses_rounds_1": own}
    poses |= {"poses_presets_fast": poses["poses"] - {"simulate", "inspect"}, "poses_claims_static": own}
    splats = {name.replace("poses", "gaussians"): {"gaussians", "render"} for name in poses}
    assert rules == poses | splats | {"gaussians": {"gaussians", "render", "viewer"}}


def test_a_job_on_a_cluster_asks_for_what_is_known_before_it_runs(repo_copy: Path) -> None:
    """A share of its input's size would have every file of the run looked up before the first job, and is unknown."""
    pytest.importorskip("snakemake_executor_plugin_slurm")
    result = run_snakemake(repo_copy, "-n", "--profile", "profiles/slurm")
    jobs = re.split(r"^ *(?=rule \w+:)", result.stdout + result.stderr, flags=re.MULTILINE)[1:]
    asked = {job.partition(":")[0].removeprefix("rule "): re.search(r"resources: (.*)", job).group(1) for job in jobs}  # type: ignore[union-attr]
    assert set(asked) == EVERY_RULE
    unknown = {name for text in asked.values() for name in re.findall(r"(\w+)=<TBD>", text)}
    assert unknown <= {"tmpdir"}
    rules = ("gaussians", "colmap", "ba")  # in the order of what they take
    minutes = [int(asked[rule].partition("runtime=")[2].partition(",")[0]) for rule in rules]
    assert minutes == sorted(minutes, reverse=True)
    assert minutes[-1] > 0


def test_a_run_on_a_cluster_writes_as_much_as_on_one_machine(repo_copy: Path) -> None:
    """Rules that say nothing of their disk would count with Snakemake's default, a gigabyte each."""
    pytest.importorskip("snakemake_executor_plugin_slurm")
    here, there = (run_snakemake(repo_copy, "-n", *profile) for profile in ((), ("--profile", "profiles/slurm")))
    told = [re.findall(r"This run writes about (.*?);", plan.stdout + plan.stderr) for plan in (here, there)]
    assert len(told[0]) == 1
    assert told[0] == told[1]
