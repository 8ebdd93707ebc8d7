"""How benchmarks time: alternated runs in one process, medians."""

import statistics
import time
from collections.abc import Callable


def alternated(works: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Median seconds of each work after a warm-up; every round runs all, so that they share the machine's moods."""
    seconds: dict[str, list[float]] = {name: [] for name in works}
    for turn in range(rounds + 1):
        for name, work in works.items():
            began = time.perf_counter()
            work()
            if turn:
                seconds[name].append(time.perf_counter() - began)
    return {name: statistics.median(values) for name, values in seconds.items()}
