"""Memory and disk that running stages hold and give back when they end, sampled from outside; Linux alone."""

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

MEMORY = ("/dev/", "/memfd:", "/SYSV")
"""How the names of mappings begin that are no files on the disk."""


@contextlib.contextmanager
def watched(folder: Path, kept: Path) -> Iterator[None]:
    """Sample the stages that run in `folder` while the block lasts.

    Args:
        kept: JSON file that receives the highest samples of every job (`held_mb`), by the path behind its `--stats`,
            beside those that it holds. It is written whenever a job ends, so that a kill loses no finished job's. A job
            that runs again begins anew. Peaks shorter than INTERVAL_S may be missed.
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
    peaks: dict[str, dict[str, float]] = read_json(kept) if kept.is_file() else {}
    before: set[str] = set()
    while True:
        last = stopped.wait(INTERVAL_S)
        now = held_mb(folder)
        for job, held in now.items():
            higher = peaks.get(job, {}) if job in before else {}
            peaks[job] = {measure: max(value, higher.get(measure, 0.0)) for measure, value in held.items()}
        if last or before - now.keys():
            write_json(kept, peaks)
        if last:
            return
        before = set(now)


def held_mb(folder: Path) -> dict[str, dict[str, float]]:
    """MB (1e6 bytes) that each stage in `folder` holds now, with the processes that it forked, by its `--stats`.

    Returns:
        `resident_mb`: memory (HELD). `meanwhile_mb`: disk, of hidden files beside the paths on its command line and of
        files without a name that it maps.
    """
    held: dict[str, dict[str, float]] = {}
    for process, words in running(folder):
        with contextlib.suppress(OSError):  # it has ended
            job = held.setdefault(stats_of(words), {"resident_mb": 0.0, "meanwhile_mb": 0.0})
            status = (line.split() for line in (process / "status").read_text().splitlines())
            kilobytes = sum(int(line[1]) for line in status if line and line[0].rstrip(":") in HELD)
            job["resident_mb"] += kilobytes * KIB
            job["meanwhile_mb"] = max(job["meanwhile_mb"], (_hidden(folder, words) + _nameless(process)) / 1e6)
    return held


def running(folder: Path) -> Iterator[tuple[Path, list[str]]]:
    """The processes (in /proc) of stages that run in `folder`, and the words of their command lines."""
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has ended, or is somebody else's
            words = (process / "cmdline").read_bytes().decode().split("\0")
            if "--stats" in words and (process / "cwd").resolve() == folder:
                yield process, words


def stats_of(words: list[str]) -> str:
    """The path behind `--stats`."""
    return words[words.index("--stats") + 1]


def _hidden(folder: Path, words: list[str]) -> int:
    """Bytes of the unfinished outputs, blocks and checkpoints that lie, hidden, beside the paths among the words."""
    paths = [folder / word for word in words if "/" in word]
    hidden = {found for path in paths for found in path.parent.glob(f".{path.stem}*")}
    files = {file for found in hidden for file in (found, *found.rglob("*"))}
    return sum(_size(file) for file in files)


def _size(file: Path) -> int:
    with contextlib.suppress(OSError):  # it got its final name
        return file.stat().st_size if file.is_file() else 0
    return 0


def _nameless(process: Path) -> int:
    """Bytes of the files without a name on the disk that a process maps."""
    sizes = {}
    for line in (process / "maps").read_text().splitlines():
        span, _, offset, device, inode, *path = line.split(maxsplit=5)
        if path and path[0].endswith("(deleted)") and path[0].startswith("/") and not path[0].startswith(MEMORY):
            start, end = (int(address, 16) for address in span.split("-"))
            sizes[device, inode, offset] = end - start
    return sum(sizes.values())
