"""Work side by side: every item once, whatever the threads; errors reach the caller."""

import threading
from pathlib import Path

import numpy as np
import pytest

from stages import kernels_compiled
from stages.shared.threads import spread


@pytest.mark.parametrize("threads", ["1", "2", "7"])
@pytest.mark.parametrize("count", [0, 1, 5, 1000])
def test_every_item_is_worked_on_once(threads: str, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", threads)
    times = np.zeros(count, int)

    def kernel(first: int, last: int, times: np.ndarray) -> None:
        times[first:last] += 1

    spread(kernel, count, times)
    assert (times == 1).all()


def test_an_error_on_any_thread_reaches_the_caller(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    both = threading.Barrier(2, timeout=30)
    caller = threading.current_thread()

    def kernel(_first: int, _last: int) -> None:
        both.wait()
        if threading.current_thread() is not caller:
            raise ZeroDivisionError

    with pytest.raises((ZeroDivisionError, threading.BrokenBarrierError)):
        spread(kernel, 2)


def test_work_within_work_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    times = np.zeros((8, 8), int)

    def entries(first: int, last: int, row: np.ndarray) -> None:
        row[first:last] += 1

    def rows(first: int, last: int) -> None:
        for row in times[first:last]:
            spread(entries, 8, row)

    spread(rows, 8)
    assert (times == 1).all()


def test_kernels_count_as_compiled_once_there_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    assert not kernels_compiled()
    (tmp_path / "cache" / "ba_0123").mkdir(parents=True)
    assert not kernels_compiled()
    (tmp_path / "cache" / "ba_0123" / "kernel._explain-82.py311.1.nbc").touch()
    assert kernels_compiled()
