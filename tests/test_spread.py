"""Work side by side: every item once, whatever the threads; errors reach the caller."""

import ast
import threading
from pathlib import Path

import numpy as np
import pytest
from conftest import REPO

from stages import KERNEL_TYPES, kernels_compiled
from stages.shared.threads import beside, spread

TYPES = {
    2: {
        *("ba.kernel.EdgeMatches", "ba.kernel.Geometry", "simulate.bvh.Tree", "simulate.raycast.Hits"),
        *("simulate.shading.Surface", "simulate.world.Materials"),
    }
}
"""Named tuples that kernels take, by the number that the cache of kernels bears."""


@pytest.mark.parametrize("threads", ["1", "2", "7"])
@pytest.mark.parametrize("count", [0, 1, 5, 1000])
def test_every_item_is_worked_on_once(threads: str, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", threads)
    times = np.zeros(count, int)

    def kernel(first: int, last: int, times: np.ndarray) -> None:
        times[first:last] += 1

    spread(kernel, count, times)
    assert (times == 1).all()


def test_the_last_runs_are_short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever takes the last one keeps the others waiting for a hundredth of the work, not for an eighth."""
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    lengths: dict[int, int] = {}
    spread(lambda first, last: lengths.update({first: last - first}), 1000)
    assert lengths[max(lengths)] < 20
    assert lengths[0] > 200


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


def test_what_runs_beside_is_another_thread_at_work_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    both = threading.Barrier(2, timeout=30)

    def met(number: int) -> int:
        both.wait()
        return number

    result = beside(met, 7)
    both.wait()
    assert result() == 7


@pytest.mark.parametrize("threads", ["1", "2"])
def test_what_no_thread_has_begun_is_done_by_the_caller(threads: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", threads)
    busy = threading.Event()
    waiting = beside(busy.wait)
    assert beside(threading.current_thread)() is threading.current_thread()
    busy.set()
    assert waiting()


def test_an_error_beside_reaches_the_caller(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    with pytest.raises(ZeroDivisionError):
        beside(lambda: 1 / 0)()


def test_kernels_count_as_compiled_once_there_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    assert not kernels_compiled()
    (tmp_path / "cache" / "ba_0123").mkdir(parents=True)
    assert not kernels_compiled()
    (tmp_path / "cache" / "ba_0123" / "kernel._explain-82.py311.1.nbc").touch()
    assert kernels_compiled()


def test_named_tuples_of_kernels_are_those_of_the_cache() -> None:
    """Numba fails on an index that it wrote under another name of a type."""
    parsed = {path.relative_to(REPO): ast.parse(path.read_text()) for path in REPO.glob("stages/*/*.py")}
    functions = [node for tree in parsed.values() for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    kernels = [node for node in functions if any("njit" in ast.dump(mark) for mark in node.decorator_list)]
    taken = {ast.unparse(argument.annotation) for node in kernels for argument in node.args.args if argument.annotation}
    found = {
        f"{path.parent.name}.{path.stem}.{node.name}"
        for path, tree in parsed.items()
        for node in tree.body
        if isinstance(node, ast.ClassDef) and node.name in taken and "NamedTuple" in map(ast.unparse, node.bases)
    }
    assert found == TYPES[KERNEL_TYPES], "raise stages.KERNEL_TYPES, and add the names under the new number"
