"""Logging and progress: bars on a terminal, sparse lines in the log file, stdout left empty."""

import logging
import sys
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TypeVar

from tqdm import tqdm

ItemT = TypeVar("ItemT")
logger = logging.getLogger("motionsplat")


def setup(log: Path | None) -> None:
    """Send everything to `log` (if given) and warnings to stderr."""
    logger.setLevel(logging.INFO)
    logger.propagate = False
    for old in logger.handlers[:]:
        logger.removeHandler(old)
        old.close()
    terminal = logging.StreamHandler(sys.stderr)
    terminal.setLevel(logging.WARNING)
    terminal.setFormatter(logging.Formatter("%(message)s"))
    logger.addHandler(terminal)
    if log is not None:
        log.parent.mkdir(parents=True, exist_ok=True)
        file = logging.FileHandler(log, mode="w", encoding="utf-8")
        file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
        logger.addHandler(file)


def progress(items: Collection[ItemT], title: str) -> Iterator[ItemT]:
    """Yield `items` with a bar on a terminal and a log line at every tenth of the way."""
    total, last_tenth = len(items), 0
    bar = tqdm(items, desc=title, leave=False, disable=not sys.stderr.isatty())
    for done, item in enumerate(bar, start=1):
        yield item
        if done * 10 // total > last_tenth:
            last_tenth = done * 10 // total
            logger.info("%s: %d of %d", title, done, total)
