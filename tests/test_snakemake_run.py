"""Snakemake forked from a loaded process says what a new one says, and is stopped where it takes too long."""

import subprocess
import sys
import time
from pathlib import Path

import pytest
import snakemake_run

SNAKEFILE = """
import os, sys
print(list(dict.fromkeys(path for path in sys.path if os.path.isdir(path))), sys.argv[1:])
rule all:
    output: "done"
    shell: "{command}"
"""


@pytest.mark.parametrize("command", ["echo made > {output}", "false", "unknown {nothing}"])
def test_it_is_as_a_new_process(command: str, tmp_path: Path) -> None:
    (tmp_path / "Snakefile").write_text(SNAKEFILE.format(command=command))
    arguments = ("--cores", "1", "--quiet", "all", "--forceall")
    forked = snakemake_run.run(tmp_path, arguments, 100)
    made = (tmp_path / "done").exists()
    new = subprocess.run(
        [sys.executable, "-m", "snakemake", *arguments], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (forked.returncode, made) == (new.returncode, command.startswith("echo"))
    assert forked.stdout == new.stdout
    assert len(forked.stderr.splitlines()) == len(new.stderr.splitlines())


def test_it_is_stopped_where_it_takes_too_long(tmp_path: Path) -> None:
    (tmp_path / "Snakefile").write_text(SNAKEFILE.format(command="sleep 60"))
    begun = time.monotonic()
    with pytest.raises(subprocess.TimeoutExpired):
        snakemake_run.run(tmp_path, ("--cores", "1"), 3)
    assert time.monotonic() - begun < 20
