"""What the work of a stage has cost, with the runs before it that were killed and whose work it goes on with."""

import os
import resource
import shutil
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import stages
from stages.shared.artifacts import read_json, unless_damaged, write_json
from stages.shared.log import logger

SUMS = ("wall_s", "cpu_s")
PEAKS = ("peak_mb", "gpu_peak_mb")
ORIGIN, SPENT = "origin.json", "spent.json"
"""Beside the work that is kept. The first is written once: a power cut, which damages what was written last, does not
cost the work."""
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


def goes_on(folder: Path, origin: str) -> bool:
    """Whether a killed run left work of this origin in a folder; its costs are taken over, other work is deleted."""
    if not folder.exists():
        return False
    found = _read(folder / ORIGIN)
    if found is not None and found["origin"] == origin:
        take_over(_read(folder / SPENT) or {})
        return True
    logger.info("what an earlier run has left in %s has other inputs, options or code: starting anew", folder.name)
    shutil.rmtree(folder)
    return False


def begin(folder: Path, origin: str) -> None:
    """Make a folder for work that is kept, and write into it, once, where that is from."""
    if not (folder / ORIGIN).exists():
        write_json(folder / ORIGIN, {"origin": origin})


def keep(folder: Path) -> None:
    """Write beside the work in a folder what it has cost so far."""
    write_json(folder / SPENT, spent())


def _read(path: Path) -> dict[str, Any] | None:
    return unless_damaged(lambda: read_json(path)) if path.exists() else None
