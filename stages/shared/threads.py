"""Work on many items side by side: OpenCV, numpy and compiled kernels let go of the interpreter."""

import functools
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import cv2

ResultT = TypeVar("ResultT")
RUNS = 4
"""Runs of items per thread: the threads that finish first take what is left."""


def threaded(function: Callable[..., ResultT], *items: Iterable[Any]) -> list[ResultT]:
    """What `map` gives, in its order, computed on all threads of the job.

    OpenCV itself runs on one thread meanwhile: its own threads would only compete, and a few of its functions round
    differently with their number.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with ThreadPoolExecutor(int(os.environ["OMP_NUM_THREADS"])) as pool:
            return list(pool.map(function, *items))
    finally:
        cv2.setNumThreads(before)


def spread(kernel: Callable[..., Any], count: int, *arguments: Any) -> None:
    """Call `kernel(first, last, *arguments)` on runs of the items 0..count, side by side on all threads of the job.

    The kernel is compiled with `nogil`, and what it writes about an item depends on no other item. Numba's own
    parallel loops take two to four times as long to compile: each passes through LLVM once as a function, once as
    its wrapper and once as part of the caller.
    """
    threads = int(os.environ["OMP_NUM_THREADS"])
    parts = min(count, RUNS * threads)
    if threads == 1 or parts <= 1:
        kernel(0, count, *arguments)
        return
    runs = iter([(part * count // parts, (part + 1) * count // parts) for part in range(parts)])

    def work() -> None:
        for first, last in runs:  # an iterator over a list hands every entry to one thread
            kernel(first, last, *arguments)

    helpers = [_pool(threads - 1).submit(work) for _ in range(min(threads, parts) - 1)]
    work()
    for helper in helpers:
        if not helper.cancel():  # one that has not begun finds nothing left to do
            helper.result()


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads)
