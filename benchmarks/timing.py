"""Timing of benchmarks: medians of alternated runs in one process."""

import statistics
import time
from collections.abc import Callable, Mapping


def alternated(
    works: Mapping[str, Callable[[], object]], rounds: int, clock: Callable[[], float] = time.perf_counter
) -> dict[str, float]:
    """Median seconds of each function in `works` after a warm-up.

    Every round calls all functions, so that changes of the machine's load affect all of them.

    Args:
        clock: wall time by default; `time.process_time` for the CPU seconds of all threads.
    """
    seconds: dict[str, list[float]] = {name: [] for name in works}
    for turn in range(rounds + 1):
        for name, work in works.items():
            began = clock()
            work()
            if turn:
                seconds[name].append(clock() - began)
    return {name: statistics.median(values) for name, values in seconds.items()}
