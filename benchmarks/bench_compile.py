"""Time to compile the numba kernels on a machine with an empty cache, kernel by kernel.

Run as `python -m benchmarks.bench_compile`. The stages of the demo run on the first frames of its scene, each in a
process of its own, with an empty cache of kernels and then again with the filled one. Seconds are CPU seconds of the
compiling thread, without imports; the time of a kernel's callees counts for these alone. The last line compares whole
processes: all stages with the empty cache minus all stages with the filled one.
"""

import json
import os
import re
import runpy
import shlex
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import yaml

from stages.shared.chain import AFTER, BEFORE, REPEATED

REPO = Path(__file__).parents[1]
FRAMES = 5
GATE_S = 70.0
OPTIONS: dict[str, Any] = {
    "dataset": "simulated",
    "scenes": ["demo.yaml"],
    "gaussians": {"steps": 120},
    "render": {"novel_views": 2},
    "colmap": {"mappers": ["global"], "window": 3, "upsample": [1], "upsample_masked": []},
}
"""Options of the demo, reduced in ways that change no kernel."""


def stage_commands(folder: Path) -> list[list[str]]:
    """Module and flags of every stage of the demo on `FRAMES` frames, in an order in which they can run in `folder`."""
    scene = yaml.safe_load((REPO / "stages/simulate/scenes/demo.yaml").read_text()) | {"frames": FRAMES}
    (folder / "demo.yaml").write_text(yaml.safe_dump(scene))
    (folder / "mine.yaml").write_text(yaml.safe_dump(OPTIONS))
    command = [sys.executable, "-m", "snakemake", "-s", str(REPO / "Snakefile"), "--directory", str(folder)]
    command += ["--cores", str(os.cpu_count()), "--dry-run", "--printshellcmds", "--configfile", "mine.yaml"]
    plan = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    commands = re.findall(r"python -m (stages\..*?); } 2>>", plan.stdout + plan.stderr)
    return sorted(map(shlex.split, commands), key=_when)


def _when(command: list[str]) -> tuple[int, int, int]:
    """Sort key for the order of the stages, since a dry run lists the jobs of a group by name."""
    stage = command[0].removeprefix("stages.")
    if stage in REPEATED:
        number = re.search(r"/round(\d+)/", command[command.index("--stats") + 1])
        return 1, int(number[1]) if number else sys.maxsize, REPEATED.index(stage)
    before, after = ("simulate", *BEFORE), (*AFTER[:-1], "colmap", AFTER[-1], "report")
    return (0, 0, before.index(stage)) if stage in before else (2, 0, after.index(stage))


def run_recorded(record: Path, module: str, *flags: str) -> None:
    """Run a stage like `python -m`, and write what it compiles to `record`: [kernel, signature, own CPU seconds]."""
    from numba.core import event

    class Stopwatch(event.Listener):  # type: ignore[misc]
        def __init__(self) -> None:
            self.open: list[tuple[float, float]] = []
            self.compiled: list[tuple[str, str, float]] = []

        def on_start(self, _event: event.Event) -> None:
            self.open.append((time.thread_time(), 0.0))

        def on_end(self, event: event.Event) -> None:
            began, inside = self.open.pop()
            whole = time.thread_time() - began
            if self.open:
                outer, others = self.open[-1]
                self.open[-1] = outer, others + whole
            function = event.data["dispatcher"].py_func
            name = f"{function.__module__}.{function.__qualname__}"
            self.compiled.append((name, str(event.data["args"]), whole - inside))

    watch = Stopwatch()
    event.register("numba:compile", watch)
    sys.argv = [module, *flags]
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    finally:
        record.write_text(json.dumps(watch.compiled))


def run_stages(folder: Path, commands: list[list[str]], cache: Path) -> tuple[list[list[Any]], dict[str, float]]:
    """All kernels that the stages compiled, and the CPU seconds of their processes by stage."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": str(REPO)}
    record, compiled, seconds = folder / "record.json", list[list[Any]](), defaultdict[str, float](float)
    for command in commands:
        before = os.times()
        recorded = [sys.executable, "-m", "benchmarks.bench_compile", str(record), *command]
        subprocess.run(recorded, cwd=folder, env=environment, check=True, stdout=subprocess.DEVNULL)
        after = os.times()
        used = after.children_user + after.children_system - before.children_user - before.children_system
        seconds[command[0]] += used
        compiled += json.loads(record.read_text())
    return compiled, seconds


def main() -> None:
    """Print a line per kernel, the slowest first, and the sums; fail if compiling takes longer than the gate."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        commands, cache = stage_commands(folder), folder / "cache"
        compiled, cold = run_stages(folder, commands, cache)
        again, warm = run_stages(folder, commands, cache)
    kernels: dict[str, list[float]] = defaultdict(list)
    for kernel, _, seconds in compiled:
        kernels[kernel].append(seconds)
    for kernel, parts in sorted(kernels.items(), key=lambda item: -sum(item[1])):
        print(f"{sum(parts):7.2f} s  {len(parts)} x  {kernel}")
    total_s = sum(sum(parts) for parts in kernels.values())
    print(f"{total_s:7.2f} s  in {len(compiled)} specialisations of {len(kernels)} kernels (at most {GATE_S:.0f} s)")
    for stage in cold:
        print(f"{cold[stage] - warm[stage]:7.2f} s  {stage}: {cold[stage]:.1f} cold, {warm[stage]:.1f} warm")
    print(f"{sum(cold.values()) - sum(warm.values()):7.2f} s  all stages cold less warm, {sum(cold.values()):.1f} cold")
    if again or total_s > GATE_S:
        raise SystemExit(f"compiling took {total_s:.0f} s, and {len(again)} specialisations were compiled again")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        run_recorded(Path(sys.argv[1]), *sys.argv[2:])
    else:
        main()
