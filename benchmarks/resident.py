"""Memory that running stages hold and cannot give back, sampled from outside; Linux alone."""

import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path

from stages.shared.artifacts import read_json, write_json

INTERVAL_S = 0.25
KIB = 2**10 / 1e6
"""Megabytes (1e6 bytes) in a kB of /proc."""
HELD = ("RssAnon", "RssShmem")
"""What stays until the process frees it. The rest of its resident pages are those of mapped files (RssFile): the kernel
takes them back without writing whenever memory is short, so a peak with them tells what was free, not what is needed.
"""


@contextlib.contextmanager
def watched(folder: Path, kept: Path) -> Iterator[None]:
    """Sample the stages that run in `folder` while the block lasts.

    Args:
        kept: JSON file that receives the highest sample of every job in MB (1e6 bytes), by the path behind its
            `--stats`, beside those that it holds. It is written whenever a job ends, so that a kill loses no finished
            job's. A job that runs again begins anew. Peaks shorter than INTERVAL_S may be missed.
    """
    stopped = threading.Event()
    sampler = threading.Thread(target=_sample, args=[folder.resolve(), kept, stopped], daemon=True)
    sampler.start()
    try:
        yield
    finally:
        stopped.set()
        sampler.join()


def _sample(folder: Path, kept: Path, stopped: threading.Event) -> None:
    peaks: dict[str, float] = read_json(kept) if kept.is_file() else {}
    before: set[str] = set()
    while True:
        last = stopped.wait(INTERVAL_S)
        now = held_mb(folder)
        for job, megabytes in now.items():
            peaks[job] = max(megabytes, peaks.get(job, 0.0) if job in before else 0.0)
        if last or before - now.keys():
            write_json(kept, peaks)
        if last:
            return
        before = set(now)


def held_mb(folder: Path) -> dict[str, float]:
    """MB (1e6 bytes) that each stage in `folder` holds now, with the processes that it forked, by its `--stats`."""
    held: dict[str, float] = {}
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has ended, or is somebody else's
            words = (process / "cmdline").read_bytes().split(b"\0")
            if b"--stats" in words and (process / "cwd").resolve() == folder:
                status = (line.split() for line in (process / "status").read_text().splitlines())
                kilobytes = sum(int(line[1]) for line in status if line and line[0].rstrip(":") in HELD)
                job = words[words.index(b"--stats") + 1].decode()
                held[job] = held.get(job, 0.0) + kilobytes * KIB
    return held
