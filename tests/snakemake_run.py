"""Snakemake in a process forked from one that has its modules loaded: they take longer to load than a plan to make.

It differs from a new process in what is read at a start, as the seed of hashes is. Give `env` for that.
"""

import multiprocessing
import os
import runpy
import subprocess
import sys
import tempfile
from pathlib import Path

_LOADED = multiprocessing.get_context("forkserver")
_LOADED.set_forkserver_preload(["snakemake.cli"])


def run(folder: Path, arguments: tuple[str, ...], timeout_s: float) -> subprocess.CompletedProcess[str]:
    """`python -m snakemake ARGUMENTS` in `folder` and in this environment, with its output as text.

    Raises subprocess.TimeoutExpired after `timeout_s` seconds, in which it has been stopped.
    """
    with tempfile.TemporaryDirectory() as name:
        said = [Path(name) / "stdout", Path(name) / "stderr"]
        process = _LOADED.Process(target=_snakemake, args=(folder, arguments, dict(os.environ), _path(folder), said))
        process.start()
        try:
            process.join(timeout_s)
            if process.exitcode is None:
                raise subprocess.TimeoutExpired(["snakemake", *arguments], timeout_s)
        finally:
            process.kill()  # else the end of the tests would wait for it
            process.join()
        stdout, stderr = (path.read_text() if path.exists() else "" for path in said)
    return subprocess.CompletedProcess(["snakemake", *arguments], process.exitcode, stdout, stderr)


def _snakemake(
    folder: Path, arguments: tuple[str, ...], environment: dict[str, str], path: list[str], said: list[Path]
) -> None:
    """The process itself: its streams are files, and it finds no modules that only tests see."""
    for file, stream in zip(said, (sys.stdout, sys.stderr), strict=True):
        os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT), stream.fileno())
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    sys.path[:] = [str(folder), *path]
    sys.argv = ["snakemake", *arguments]
    runpy.run_module("snakemake", run_name="__main__", alter_sys=True)


def _path(folder: Path) -> list[str]:
    """Where a new process in `folder` finds modules, but for the folder itself.

    A new one is asked: pytest adds folders to the path of this one, and the installed package may lie in one of them.
    """
    asked = [sys.executable, "-c", "import sys; print(*sys.path[1:], sep='\\n')"]
    return subprocess.run(asked, cwd=folder, capture_output=True, text=True, check=True).stdout.splitlines()
