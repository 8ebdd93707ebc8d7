"""What the work of a stage has cost, with the runs before it that were killed and whose work it goes on with."""

import os
import resource
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import stages
from stages.shared.artifacts import read_json, unless_damaged, write_json

SUMS = ("wall_s", "cpu_s")
PEAKS = ("peak_mb", "gpu_peak_mb")
_before: dict[str, Any] = {}
"""The costs of the runs before, up to what they have left."""


def spent() -> dict[str, Any]:
    """Seconds and largest memory (MB) up to now; `taken_over_s`: those wall seconds that runs before have spent.

    What a killed run did after it had last kept its work is in no file, and not counted.
    """
    own, children = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    torch = sys.modules.get("torch")
    on_gpu = torch is not None and torch.cuda.is_available() and torch.cuda.max_memory_allocated() > 0
    costs = {
        "threads": int(os.environ["OMP_NUM_THREADS"]),
        "wall_s": time.perf_counter() - stages.START_S,
        "taken_over_s": _before.get("wall_s", 0.0),
        "cpu_s": own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime,
        "peak_mb": max(own.ru_maxrss, children.ru_maxrss) / 1024,
        "gpu_peak_mb": torch.cuda.max_memory_allocated() / 2**20 if torch is not None and on_gpu else None,
    }
    costs |= {key: costs[key] + _before[key] for key in SUMS if key in _before}
    for key in PEAKS:
        costs[key] = max((peak for peak in (costs[key], _before.get(key)) if peak is not None), default=None)
    return costs


def take_over(costs: Mapping[str, Any]) -> None:
    """Count what a killed run had `spent` when it kept the work that this run goes on with."""
    _before.update(costs)


def keep(path: Path, origin: str) -> None:
    """Write beside the work that is kept where it is from, and what it has cost so far."""
    write_json(path, {"origin": origin, "spent": spent()})


def goes_on(path: Path, origin: str) -> bool:
    """Whether what a killed run has kept beside `path` is of this origin; then its costs are taken over."""
    kept = unless_damaged(lambda: read_json(path)) if path.exists() else None
    if kept is None or kept["origin"] != origin:
        return False
    take_over(kept["spent"])
    return True
