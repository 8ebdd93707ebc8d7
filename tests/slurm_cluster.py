"""A Slurm of one node on this machine, in a folder of its own: munged, slurmctld and slurmd for the time of a test."""

import contextlib
import ctypes
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

DAEMONS = ("munged", "slurmctld", "slurmd")
CPUS, MEMORY_MB = 2, 8000  # Slurm counts them; the machine need not have as many to itself
START_S = 30
CONFIGURATION = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller_port}
SlurmdPort={node_port}
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SlurmdParameters=config_overrides
ReturnToService=2
MinJobAge=86400
MessageTimeout=60
SchedulerParameters=sched_interval=1,bf_interval=1
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
NodeName={host} NodeAddr=127.0.0.1 CPUs={cpus} RealMemory={memory} State=UNKNOWN
PartitionName=all Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""


def missing() -> str | None:
    """Why a Slurm cannot be had here; None where it can."""
    absent = [name for name in DAEMONS if shutil.which(name) is None]
    if absent:
        return f"no {', '.join(absent)}: apt-get install --no-install-recommends slurmctld slurmd slurm-client munge"
    if find_spec("snakemake_executor_plugin_slurm") is None:
        return "no snakemake-executor-plugin-slurm: pip install it"
    if sys.platform != "linux" or os.geteuid() != 0:
        return "only root can start slurmd"
    return None


@contextlib.contextmanager
def running_slurm(folder: Path) -> Iterator[dict[str, str]]:
    """The environment in which `sbatch` reaches a Slurm whose files lie in `folder`; its daemons end with the block.

    Raises RuntimeError with the daemons' last words where the node does not come up.
    """
    environment = _configure(folder)
    munged = ["munged", "--foreground", "--force", *_munge_flags(folder)]
    daemons = [munged, ["slurmctld", "-D"], ["slurmd", "-D", "-N", socket.gethostname()]]
    started: list[subprocess.Popen[bytes]] = []
    try:
        for command in daemons:
            with (folder / f"{command[0]}.out").open("wb") as words:
                process = subprocess.Popen(
                    command, env=environment, stdout=words, stderr=words, preexec_fn=_end_with_the_test
                )
            started.append(process)
            if command is munged:
                _wait_for(lambda: (folder / "munge.socket").exists(), folder)
        _wait_for(lambda: "idle" in _said(["sinfo", "--noheader", "--format=%t"], environment), folder)
        yield environment
    finally:
        _said(["scancel", "--user=root", "--full", "--signal=KILL"], environment)
        for daemon in reversed(started):
            daemon.terminate()
        for daemon in reversed(started):
            try:
                daemon.wait(timeout=15)
            except subprocess.TimeoutExpired:
                daemon.kill()


def jobs(environment: dict[str, str]) -> list[dict[str, Any]]:
    """Every job that was submitted, oldest first: its state, CPUs, limits in minutes and megabytes, and its rules."""
    text = _said(["squeue", "--states=all", "--noheader", "--sort=i", "--format=%T|%C|%l|%m|%k"], environment)
    rows = [line.split("|", 4) for line in text.splitlines()]
    return [
        {
            "state": state,
            "cpus": int(cpus),
            "minutes": _minutes(limit),
            "memory_mb": int(memory.removesuffix("M")),
            "rules": rules,
        }
        for state, cpus, limit, memory, rules in rows
    ]


def _minutes(limit: str) -> int:
    """Minutes of a time limit as squeue prints it: [days-][hours:]minutes:seconds."""
    days, _, clock = limit.rpartition("-")
    hours, minutes, _ = ["0", *clock.split(":")][-3:]
    return (int(days or 0) * 24 + int(hours)) * 60 + int(minutes)


def _configure(folder: Path) -> dict[str, str]:
    """Write the configuration; the environment that leads to it."""
    for name in ("state", "spool", "bin"):
        (folder / name).mkdir(parents=True)
    values = {"host": socket.gethostname(), "folder": folder, "cpus": CPUS, "memory": MEMORY_MB}
    ports = {"controller_port": _free_port(), "node_port": _free_port()}
    (folder / "slurm.conf").write_text(CONFIGURATION.format(**values, **ports))
    (folder / "cgroup.conf").write_text("CgroupPlugin=cgroup/v1\n" if Path("/sys/fs/cgroup/memory").exists() else "")
    key = folder / "munge.key"
    key.write_bytes(os.urandom(1024))
    key.chmod(0o400)
    # The plugin's job steps drop SLURM_CONF on the way to srun, so a srun of our own brings it back.
    srun = folder / "bin" / "srun"
    srun.write_text(f'#!/bin/sh\nSLURM_CONF={folder}/slurm.conf exec {shutil.which("srun")} "$@"\n')
    srun.chmod(0o755)
    path = os.pathsep.join([str(folder / "bin"), os.environ["PATH"]])
    return {**os.environ, "SLURM_CONF": str(folder / "slurm.conf"), "PATH": path}


def _end_with_the_test() -> None:
    """Let the kernel end this daemon with the process that started it, even a killed one (1 is PR_SET_PDEATHSIG)."""
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)


def _munge_flags(folder: Path) -> list[str]:
    files = {"key-file": "munge.key", "socket": "munge.socket", "pid-file": "munge.pid", "seed-file": "munge.seed"}
    return [f"--{flag}={folder / name}" for flag, name in files.items()]


def _free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def _said(command: list[str], environment: dict[str, str]) -> str:
    """What a command of Slurm prints; nothing where it fails, as before the controller answers."""
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=20, check=False)
    except subprocess.TimeoutExpired:
        return ""
    return done.stdout


def _wait_for(reached: Callable[[], bool], folder: Path) -> None:
    """Wait until a step of the start is reached."""
    end = time.monotonic() + START_S
    while not reached():
        if time.monotonic() > end:
            words = [
                f"{path.name}: {path.read_text(errors='replace')[-800:]}" for path in folder.glob("*.[lo][ou][gt]")
            ]
            raise RuntimeError("Slurm did not start in time\n" + "\n".join(words))
        time.sleep(0.2)
