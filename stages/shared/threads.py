"""Work on many items side by side: OpenCV, numpy and compiled kernels let go of the interpreter."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import cv2

ResultT = TypeVar("ResultT")


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
