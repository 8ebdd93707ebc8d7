"""Seconds that a kill costs in flow, adjustment and training of a clip that `bench_long` has run.

    python -m benchmarks.kill_and_resume --folder bench_long --config preset=fast rounds=2

Each stage runs again on the whole clip, is killed once it has taken `--after` of the time that it took before, and is
started again, as a user would. Lost is the time of both over that of the run before. Further words go to Snakemake;
they are those that `bench_long` was given. Wall seconds need an otherwise idle machine.
"""

import argparse
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.bench_memory import REPO, command_of
from benchmarks.resident import running, stats_of
from stages.shared.artifacts import read_json

STAGES = ("gaussians", "ba", "flow")
"""Those that go on where they stood, last first: all that follow one whose results are written anew would run again."""
MOST_S = 60.0
GRACE_S = 600.0
"""Within this time Snakemake has begun the stage."""


def killed(command: list[str], folder: Path, stats: str, after_s: float) -> float:
    """Run the workflow, and kill the stage that writes `stats` after so many seconds; those that it ran.

    Raises:
        SystemExit: if the stage does not begin, or ends before.
    """
    with subprocess.Popen(command, cwd=REPO, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as workflow:
        deadline = time.monotonic() + GRACE_S
        while not (found := [process for process, words in running(folder) if stats_of(words) == stats]):
            if workflow.poll() is not None or time.monotonic() > deadline:
                workflow.terminate()
                sys.exit(f"{stats}: its stage did not begin; is it of the configured run?")
            time.sleep(0.1)
        began = time.monotonic()
        time.sleep(after_s)
        if not all(process.exists() for process in found):
            sys.exit(f"{stats}: its stage ended before it was killed; give a smaller --after")
        for process in found:
            os.kill(int(process.name), signal.SIGKILL)
        return time.monotonic() - began


def lost(folder: Path, home: Path, stage: str, after: float, words: list[str]) -> tuple[float, float, float]:
    """Seconds of the stage before, of the run that was killed, and of the one that went on.

    The times of the stage before are put back: those of this one hold the reading of what was kept.
    """
    stats = home / "stats" / f"{stage}.json"
    before, whole_s = stats.read_bytes(), float(read_json(stats)["wall_s"])
    stats.unlink()
    within = str(stats.relative_to(folder))
    command = command_of(folder, read_json(folder / "options.json"), "--cores", "all", within, *words)
    try:
        killed_s = killed(command, folder, within, after * whole_s)
        subprocess.run(command, cwd=REPO, stdout=subprocess.DEVNULL, check=True)
        costs = read_json(stats)
    finally:
        stats.write_bytes(before)
    return whole_s, killed_s, float(costs["wall_s"] - costs["taken_over_s"])


def main() -> None:
    """Kill and resume every stage; the exit code is 1 if more than MOST_S were lost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("bench_long"), help="of `bench_long`")
    parser.add_argument("--after", type=float, default=0.7, help="share of the stage's time, 0..1")
    given, words = parser.parse_known_args()
    folder = given.folder.resolve()
    homes = [path.parent for path in (folder / "results").glob("*/*/sequence.json")]
    if len(homes) != 1:
        sys.exit(f"{folder}: expected the results of one sequence, found {len(homes)}; run bench_long there first")
    missed = False
    for stage in STAGES:
        whole_s, killed_s, resumed_s = lost(folder, homes[0], stage, given.after, words)
        lost_s = killed_s + resumed_s - whole_s
        missed |= lost_s > MOST_S
        print(f"{stage}: {whole_s:.1f} s; killed after {killed_s:.1f}, then {resumed_s:.1f} s: {lost_s:.1f} s lost")
    sys.exit(int(missed))


if __name__ == "__main__":
    main()
