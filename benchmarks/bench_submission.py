"""Time from `snakemake` to its first job, on a dataset of a thousand sequences.

Run as `python -m benchmarks.bench_submission [--sequences 1000]`. The sequences are folders of
24 small frames, hard links of one file each. Snakemake runs on this machine and then with the Slurm profile, whose
`sbatch` is a script that notes that it was called; either ends at its first job. Prints wall and CPU seconds.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

REPO = Path(__file__).parents[1]
FRAMES = 24
ON_SLURM = ["--profile", str(REPO / "profiles/slurm"), "--slurm-no-account"]
COMMANDS = {"sbatch": "#!/bin/sh\ntouch {mark}\necho 1\n", "sinfo": "#!/bin/sh\necho 'all*'\n"}
"""What the plugin calls until a job is submitted."""
DEADLINE_S = 300.0


def write_sequences(folder: Path, count: int) -> Path:
    """A folder of `count` sequences, each of the same `FRAMES` frames."""
    shared, dataset = folder / "frames", folder / "data"
    shared.mkdir()
    rng = np.random.default_rng(0)
    for k in range(FRAMES):
        cv2.imwrite(str(shared / f"frame_{k + 1:04d}.png"), rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))
    for number in range(count):
        sequence = dataset / f"clip_{number:04d}"
        sequence.mkdir(parents=True)
        for frame in shared.iterdir():
            os.link(frame, sequence / frame.name)
    return dataset


def write_commands(folder: Path, mark: Path) -> Path:
    """A folder with Slurm's commands, of which `sbatch` makes the file `mark`."""
    folder.mkdir()
    for name, script in COMMANDS.items():
        (folder / name).write_text(script.format(mark=mark))
        (folder / name).chmod(0o755)
    return folder


def seconds_to(mark: Path, command: list[str], folder: Path, path: str) -> tuple[float, float]:
    """Wall and CPU seconds of `command` in `folder` until the file or folder `mark` is there; then it is ended.

    Raises:
        RuntimeError: if the command ends before, or takes longer than `DEADLINE_S`.
    """
    log = folder / "snakemake.log"
    began = time.perf_counter()
    with log.open("wb") as words:
        environment = os.environ | {"PATH": path}
        process = subprocess.Popen(
            command, cwd=folder, env=environment, stdout=words, stderr=words, start_new_session=True
        )
    while not mark.exists():
        if process.poll() is not None or time.perf_counter() - began > DEADLINE_S:
            os.killpg(process.pid, signal.SIGKILL)
            raise RuntimeError(f"no job began:\n{log.read_text()[-2000:]}")
        time.sleep(0.02)
    wall = time.perf_counter() - began
    spent = sum(float(part) for part in Path(f"/proc/{process.pid}/stat").read_text().rsplit(")")[1].split()[11:13])
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    return wall, spent / os.sysconf("SC_CLK_TCK")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sequences", type=int, default=1000)
    count = parser.parse_args().sequences
    for where, flags in (("this machine", ["--cores", "2"]), ("Slurm profile", ON_SLURM)):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            dataset = write_sequences(folder, count)
            mark = folder / "submitted" if flags is ON_SLURM else folder / "logs"
            path = os.pathsep.join([str(write_commands(folder / "bin", folder / "submitted")), os.environ["PATH"]])
            command = [sys.executable, "-m", "snakemake", "-s", str(REPO / "Snakefile"), "--directory", name, *flags]
            wall, cpu = seconds_to(mark, [*command, "--config", f"dataset={dataset}"], folder, path)
            print(f"{count} sequences of {FRAMES} frames, {where:13s}: first job after {wall:5.1f} s, {cpu:5.1f} CPU s")


if __name__ == "__main__":
    main()
