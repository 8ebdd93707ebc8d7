"""Logging and progress: bars on a terminal, lines with the time left in the log file, nothing on stdout."""

import logging
import os
import sys
import time
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sized
from pathlib import Path
from typing import TypeVar

from tqdm import tqdm

ItemT = TypeVar("ItemT")
logger = logging.getLogger("motionsplat")
REPORT_S = 30.0
"""Longest time between two lines of progress in the log, but for an item that takes longer itself."""


class _Kept(logging.Handler):
    """A handler that collects the warnings for the time file."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


def setup(log: Path | None) -> None:
    """Log everything to the file `log`, if any, and warnings to stderr, unless stderr is that file, as in the workflow.

    An existing file is overwritten.
    """
    logger.setLevel(logging.INFO)
    logger.propagate = False
    for old in logger.handlers[:]:
        logger.removeHandler(old)
        old.close()
    logger.addHandler(_Kept())
    if log is not None:
        log.parent.mkdir(parents=True, exist_ok=True)
        log.write_bytes(b"")
        file = logging.FileHandler(log, mode="a", encoding="utf-8")  # stderr may be appended to the same file
        file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
        logger.addHandler(file)
        if _is_stderr(log):
            return
    terminal = logging.StreamHandler(sys.stderr)
    terminal.setLevel(logging.WARNING)
    terminal.setFormatter(logging.Formatter("%(message)s"))
    logger.addHandler(terminal)


def _is_stderr(log: Path) -> bool:
    """Whether standard error is redirected to this file."""
    return sys.__stderr__ is not None and os.path.samestat(log.stat(), os.fstat(sys.__stderr__.fileno()))


def warnings() -> list[str]:
    """The warnings since `setup`, in order."""
    return [line for handler in logger.handlers if isinstance(handler, _Kept) for line in handler.lines]


def progress(items: Iterable[ItemT], title: str, total: int | None = None) -> Iterator[ItemT]:
    """Yield `items`, with a progress bar on a terminal, and lines of progress with the time left in the log file.

    A line follows every tenth of the items, and the first item that ends REPORT_S after the last line. The time left
    assumes that the items to come take as long as those of the last half of the time: what a killed run had done is
    passed over at once.

    Args:
        total: their number, which may be an estimate; None for a collection, which knows it.
    """
    if total is None:
        assert isinstance(items, Sized)
        total = len(items)
    told = time.monotonic()
    ends, last_tenth = [told], 0
    bar = tqdm(items, desc=title, total=total, leave=False, disable=not sys.stderr.isatty())
    for done, item in enumerate(bar, start=1):
        yield item
        ends.append(now := time.monotonic())
        if done * 10 // total > last_tenth or now - told >= REPORT_S:
            last_tenth, told = done * 10 // total, now
            half = bisect_left(ends, (ends[0] + now) / 2, 1) - 1
            left_s = (now - ends[half]) * (total - done) / (done - half)
            logger.info("%s: %d of %d%s", title, done, total, f", {duration(left_s)} left" if done < total else "")


def duration(seconds: float) -> str:
    """A duration in words, rounded to what is of use to somebody who waits: "40 s", "3 min", "2 h 10 min"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"
