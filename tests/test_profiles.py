"""What a profile says is what a run gets: the one that Snakemake finds by itself, and the one for a cluster."""

import os
import sys
from argparse import Namespace
from collections.abc import Callable

import pytest
from conftest import REPO
from snakemake.cli import parse_args

Settings = Callable[..., Namespace]


@pytest.fixture
def settings(monkeypatch: pytest.MonkeyPatch) -> Settings:
    """What `snakemake ARGUMENTS` beside the Snakefile would run with."""
    monkeypatch.chdir(REPO)
    monkeypatch.delenv("SNAKEMAKE_PROFILE", raising=False)

    def parsed(*arguments: str) -> Namespace:
        monkeypatch.setattr(sys, "argv", ["snakemake", *arguments])
        return parse_args(list(arguments))[1]

    return parsed


def test_plain_snakemake_takes_this_machine(settings: Settings) -> None:
    found = settings()
    assert (found.executor, found.cores, found.jobs, found.max_threads) == (
        None,
        len(os.sched_getaffinity(0)),
        None,
        None,
    )
    assert limits(found) == {"gpu": 1, "colmap": 1}
    assert (found.logger, found.keep_going, found.rerun_incomplete) == (["motionsplat"], True, True)


@pytest.mark.parametrize("flags", [["--profile", "profiles/slurm"], ["--profile=profiles/slurm"], []])
def test_a_cluster_gets_what_its_profile_says(
    settings: Settings, monkeypatch: pytest.MonkeyPatch, flags: list[str]
) -> None:
    pytest.importorskip("snakemake_executor_plugin_slurm")
    if not flags:
        monkeypatch.setenv("SNAKEMAKE_PROFILE", "profiles/slurm")
    found = settings(*flags)
    assert (found.executor, found.cores, found.jobs, found.max_threads, found.retries) == ("slurm", 4, 100, 4, 2)
    assert (found.logger, found.keep_going, found.rerun_incomplete) == (["motionsplat"], True, True)
    assert settings(*flags, "--cores", "2").cores == 2


def limits(found: Namespace) -> dict[str, int]:
    return {name: resource.value for name, resource in found.resources.items()}
