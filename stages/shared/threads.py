"""Work on many items in parallel threads: OpenCV, numpy and compiled kernels release the interpreter lock."""

import functools
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any, TypeVar

import cv2

ResultT = TypeVar("ResultT")
RUNS = 4
"""Runs of items per thread: threads that finish early take the remaining runs."""


def threaded(function: Callable[..., ResultT], *items: Iterable[Any]) -> list[ResultT]:
    """The results of `map`, in its order, computed on all threads of the job.

    Meanwhile OpenCV itself runs single-threaded: its own threads would compete for the cores, and the rounding of a few
    of its functions depends on their number.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with ThreadPoolExecutor(int(os.environ["OMP_NUM_THREADS"])) as pool:
            return list(pool.map(function, *items))
    finally:
        cv2.setNumThreads(before)


def spread(kernel: Callable[..., Any], count: int, *arguments: Any) -> None:
    """Call `kernel(first, last, *arguments)` on runs of the items 0..count - 1, in parallel on all threads of the job.

    The kernel is compiled with `nogil`, and its result for an item depends on no other item. Runs become shorter
    towards the end, so that no thread waits long for the last. Numba's own parallel loops take much longer to compile:
    each passes through LLVM as a function, as its wrapper and as part of the caller.
    """
    threads = int(os.environ["OMP_NUM_THREADS"])
    parts = min(count, RUNS * threads)
    if threads == 1 or parts <= 1:
        kernel(0, count, *arguments)
        return
    edges = [count + -count * (parts - part) ** 2 // parts**2 for part in range(parts + 1)]
    runs = iter([run for run in pairwise(edges) if run[0] < run[1]])

    def work() -> None:
        for first, last in runs:  # a list iterator yields every entry to one thread only
            kernel(first, last, *arguments)

    helpers = [_pool(threads - 1).submit(work) for _ in range(min(threads, parts) - 1)]
    work()
    for helper in helpers:
        if not helper.cancel():  # a helper that has not started has nothing left to do
            helper.result()


def beside(function: Callable[..., ResultT], *arguments: Any) -> Callable[[], ResultT]:
    """Begin `function(*arguments)` on another thread of the job; what is returned waits for its result and gives it.

    A thread that is at work on it takes no runs of `spread` meanwhile. If none has begun by the time that the result is
    asked for, or the job has a single thread, the caller works on it.
    """
    threads = int(os.environ["OMP_NUM_THREADS"])
    begun = _pool(threads - 1).submit(function, *arguments) if threads > 1 else None

    def result() -> ResultT:
        if begun is None or begun.cancel():
            return function(*arguments)
        return begun.result()

    return result


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads)
