"""Time of `make demo` with an empty and with a filled cache of compiled kernels.

Run as `python -m benchmarks.bench_demo`; with a file name as argument the table is also written to that file.
Both runs start in an empty folder, the first with an empty cache, the second with the cache that the first one filled.
Installation is not included. Wall seconds are meaningful only on an otherwise idle machine.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from stages.report.provenance import about_run
from stages.results.scorecard import score_row

REPO = Path(__file__).parents[1]
GOALS_S = {"no kernel compiled": 240.0, "kernels compiled": 90.0}


def run_demo(folder: Path, cache: Path) -> tuple[float, float]:
    """Wall and CPU seconds of the demo in an empty folder."""
    command = [sys.executable, "-m", "snakemake", "-s", str(REPO / "Snakefile"), "--directory", str(folder)]
    before, start_s = os.times(), time.perf_counter()
    subprocess.run(
        [*command, "--config", "preset=fast"],
        cwd=REPO,
        env=os.environ | {"NUMBA_CACHE_DIR": str(cache)},
        check=True,
        capture_output=True,
    )
    wall_s, after = time.perf_counter() - start_s, os.times()
    return wall_s, after.children_user + after.children_system - before.children_user - before.children_system


def main() -> None:
    """Print the table, and write it to the file named on the command line, if any."""
    about = about_run()
    lines = [
        "# How long the demo takes",
        "",
        "Written by `python -m benchmarks.bench_demo`; not edited by hand.",
        "",
        f"{about['written']}, commit {about['commit']}, {about['machine']}; preset `fast`, installation not counted.",
        "",
        "| `make demo` with | wall, s | CPU, s | of it our stages / COLMAP, CPU s | goal, wall s |",
        "| --- | ---: | ---: | --- | ---: |",
    ]
    with tempfile.TemporaryDirectory() as name:
        for words, goal_s in GOALS_S.items():
            folder = Path(name) / words.replace(" ", "_")
            folder.mkdir()
            wall_s, cpu_s = run_demo(folder, Path(name) / "cache")
            row = score_row(folder / "results/simulated/demo")
            shares = f"{row['cpu_s']:.0f} / {row['colmap_cpu_s']:.0f}"
            lines.append(f"| {words} | {wall_s:.0f} | {cpu_s:.0f} | {shares} | {goal_s:.0f} |")
    text = "\n".join(lines) + "\n"
    print(text)
    if len(sys.argv) > 1:
        Path(sys.argv[1]).write_text(text)


if __name__ == "__main__":
    main()
