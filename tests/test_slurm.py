"""Two sequences through profiles/slurm on a real Slurm: a killed job, the number of jobs, results as of a local run."""

import os
import signal
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml
from conftest import REPO, run_snakemake, write_scenes
from slurm_cluster import CPUS, jobs, missing, running_slurm

from stages.shared.artifacts import read_table

pytestmark = [pytest.mark.slurm, pytest.mark.skipif(missing() is not None, reason=f"no Slurm: {missing()}")]

NAMES = ("moving", "still")
OPTIONS = {
    "scenes": [f"{name}.yaml" for name in NAMES],
    "preset": "fast",
    "rounds": 1,
    "control": {"control_points": 16, "steps": 10},
    "gaussians": {"steps": 20},
    "render": {"novel_views": 2},
    "colmap": {"window": 3, "time_limit_s": 5},
}
ON_SLURM = (
    *("--profile", str(REPO / "profiles/slurm"), "--cores", str(CPUS), "--max-threads", str(CPUS)),
    # There is no accounting here, and jobs take seconds.
    *("--slurm-status-command", "squeue", "--slurm-init-seconds-before-status-checks", "2"),
)
VICTIM = "stages.motion"


@dataclass(frozen=True)
class Both:
    """The same sequences on Slurm and here, as far as the poses."""

    slurm: Path
    local: Path
    cluster: dict[str, str]
    log: str


def run(folder: Path, *arguments: str, env: dict[str, str] | None = None) -> str:
    """The repository's workflow in `folder`; what it printed."""
    where = ["-s", str(REPO / "Snakefile"), "--directory", str(folder), "--configfile", str(folder / "mine.yaml")]
    done = run_snakemake(folder, *arguments, *where, env=env)
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    return done.stdout + done.stderr


def kill_once(folder: Path, ended: threading.Event) -> None:
    """Kill the first process of the victim's stage in `folder` at work, as the kernel does where memory runs out."""
    while not ended.wait(0.02):
        for process in Path("/proc").glob("[0-9]*"):
            try:
                words = (process / "cmdline").read_text().split("\0")
                if VICTIM not in words or (process / "cwd").readlink() != folder:
                    continue
                if (folder / words[words.index("--log") + 1]).stat().st_size:
                    os.kill(int(process.name), signal.SIGKILL)
                    return
            except OSError:  # it has ended by itself
                continue


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Both]:
    """The poses of both sequences, a job killed on the way."""
    slurm, local = (tmp_path_factory.mktemp(name) for name in ("slurm", "local"))
    for folder in (slurm, local):
        write_scenes(folder, frames=6, width=160, height=72)
        (folder / "mine.yaml").write_text(yaml.safe_dump(OPTIONS))
    run(local, "poses", "masks")
    with running_slurm(tmp_path_factory.mktemp("cluster")) as cluster:
        ended = threading.Event()
        killer = threading.Thread(target=kill_once, args=(slurm, ended))
        killer.start()
        try:
            log = run(slurm, "poses", "masks", *ON_SLURM, env=cluster)
        finally:
            ended.set()
            killer.join()
        yield Both(slurm, local, cluster, log)


def results(folder: Path, name: str) -> Path:
    return folder / "results" / "simulated" / name


def assert_same_table(one: Path, other: Path, tolerance: float = 1e-6) -> None:
    """Equal but for seconds and the last digits: kernels just compiled may differ there from those loaded from disk."""
    first, second = (read_table(path) for path in (one, other))
    assert list(first) == list(second)
    for name in set(first) - {"wall_s", "cpu_s"}:
        if first[name].dtype.kind == "f":
            np.testing.assert_allclose(first[name], second[name], rtol=tolerance, atol=1e-9, err_msg=name)
        else:
            np.testing.assert_array_equal(first[name], second[name], err_msg=name)


def test_a_killed_job_runs_again_with_more_time(both: Both) -> None:
    """No stage but the killed one may fail; a job that Slurm itself loses on a busy machine runs again too."""
    submitted = jobs(both.cluster)
    told = [line for line in both.log.splitlines() if "  FAILED  " in line]
    lost = [line for line in told if "no stage says why" in line]
    failed = [line for line in told if line not in lost]
    assert [line.split()[0] for line in failed] == ["motion"], (told, both.log[-6000:])
    assert "Killed" in failed[0], failed
    states = ["COMPLETED"] * len(NAMES) + ["FAILED"] * (1 + len(lost))
    assert sorted(job["state"] for job in submitted) == states, (submitted, told)
    assert "failed:" not in both.log
    first, last = submitted[0], submitted[-1]
    assert last["minutes"] > first["minutes"]
    assert last["memory_mb"] > first["memory_mb"]
    assert all(job["cpus"] == CPUS for job in submitted)


@pytest.mark.parametrize("name", NAMES)
def test_poses_and_masks_are_those_of_a_local_run(both: Both, name: str) -> None:
    there, here = results(both.slurm, name), results(both.local, name)
    assert_same_table(there / "ba/poses.parquet", here / "ba/poses.parquet")
    masks = sorted((here / "masks").glob("*.png"))
    assert len(masks) == 6
    assert all((there / "masks" / mask.name).read_bytes() == mask.read_bytes() for mask in masks)


@pytest.mark.long
def test_a_sequence_is_four_submissions(both: Both) -> None:
    """What is left of the poses' group, COLMAP, Gaussians, evaluation; and one report of all."""
    before = len(jobs(both.cluster))
    run(both.slurm, *ON_SLURM, env=both.cluster)
    run(both.local)
    submitted = jobs(both.cluster)[before:]
    assert [job["state"] for job in submitted] == ["COMPLETED"] * (4 * len(NAMES) + 1)
    assert [job["cpus"] for job in submitted if "colmap" in job["rules"]] == [1] * len(NAMES)
    for name in NAMES:
        # Training makes more of the last digits: 4e-4 of the SSIM where a process compiled kernels on the way, else 0.
        for table, tolerance in (("poses", 1e-6), ("masks", 1e-6), ("images", 5e-3)):
            there, here = (results(folder, name) / f"eval/{table}.parquet" for folder in (both.slurm, both.local))
            assert_same_table(there, here, tolerance)
    assert (both.slurm / "results/simulated/report/index.html").exists()
