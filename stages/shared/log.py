"""Logging and progress: bars on a terminal, lines with the time left in the log file, nothing on stdout."""

import logging
import os
import sys
import time
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

ItemT = TypeVar("ItemT")
logger = logging.getLogger("motionsplat")
REPORT_S = 30.0
"""Longest time between two lines of progress in the log, but for an item that takes longer itself."""
TELLING_S = 1.0
"""Time before which nothing is said of the time left: what a killed run had done is passed over in less."""


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


def progress(
    items: Iterable[ItemT], title: str, total: int | None = None, size: Callable[[ItemT], int] | None = None
) -> Iterator[ItemT]:
    """Yield `items`, with a progress bar on a terminal, and lines of progress with the time left in the log file.

    A line follows every tenth of the items, and the first item that ends REPORT_S after the last line. The time left
    assumes that the items to come take as long as those of the last half of the time: what a killed run had done is
    passed over at once.

    Args:
        total: the sum of their sizes, which may be an estimate; None for a collection, which knows its number.
        size: how many an item counts for, if not for one: those that are done together are told together.
    """
    if total is None:
        assert isinstance(items, Sized)
        total = len(items)
    told = time.monotonic()
    done, last_tenth, points = 0, 0, [(told, 0)]
    with _bar(title, total) as move:
        for item in items:
            yield item
            count = 1 if size is None else size(item)
            if count == 0:
                continue
            move(count)
            done += count
            now = time.monotonic()
            points.append((now, done))
            if done * 10 // total > last_tenth or now - told >= REPORT_S:
                last_tenth, told = done * 10 // total, now
                logger.info("%s: %d of %d%s", title, done, total, _left(points, total))


@contextmanager
def _bar(title: str, total: int) -> Iterator[Callable[[int], object]]:
    """A progress bar on a terminal; what moves it on by some items."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    from tqdm import tqdm  # 0.035 s, which stages of a workflow do not need

    with tqdm(desc=title, total=total, leave=False) as bar:
        yield bar.update


def _left(points: list[tuple[float, int]], total: int) -> str:
    """The time left in words, from points in time with what was done by then; nothing where it cannot be told yet."""
    (first, _), (now, done) = points[0], points[-1]
    if done >= total or now - first < TELLING_S:
        return ""
    half, done_by_half = points[bisect_left(points, ((first + now) / 2, 0), 1) - 1]
    return f", {duration((now - half) * (total - done) / (done - done_by_half))} left"


def duration(seconds: float) -> str:
    """A duration in words, rounded to what is of use to somebody who waits: "40 s", "3 min", "2 h 10 min"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"
