"""Checkpoints of the adjustment: a killed run is taken up where it stood and ends with the same result, to rounding.

The adjustment is a row of long computations, each of which follows from the results of those before it: chains of
two-view motions, searches for depth, solves. Their results are kept in that order, and the state of a solve under way.
A run with the same inputs, options and code takes them instead of computing them again, and repeats what little lies
between. A run that takes less than INTERVAL_S writes nothing.
"""

import contextlib
import hashlib
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stages.ba.state import State
from stages.shared import costs
from stages.shared.artifacts import read_metadata, read_model, unless_damaged, write_model
from stages.shared.digest import code_digest
from stages.shared.log import logger
from stages.shared.options import Options

INTERVAL_S = 20.0
Kept = tuple[Mapping[str, np.ndarray], Mapping[str, Any]]
"""Arrays by name, and what else is kept as JSON."""


class Checkpoint:
    """A hidden folder beside the poses with a file per result, in order, the last of which may be unfinished."""

    def __init__(self, poses: Path, inputs: Sequence[Path], options: Options) -> None:
        self.folder = poses.with_name(f".{poses.stem}.checkpoint")
        self.origin = _fingerprint(inputs, options)
        self.index, self.saved_s = -1, time.perf_counter()
        self.waiting: list[tuple[int, Kept]] = []
        if costs.goes_on(self.folder, self.origin):
            logger.info("resumed behind %d kept results", len(list(self.folder.glob("*.safetensors"))))

    def begin(self) -> Kept | None:
        """Go on to the next computation; its result, or how far it had come, if that is kept."""
        self.index += 1
        path = self._path(self.index)
        return unless_damaged(lambda: (read_model(path), read_metadata(path))) if path.exists() else None

    def finished(self, arrays: Mapping[str, np.ndarray], about: Mapping[str, Any]) -> None:
        """Keep the result of the present computation."""
        self.waiting.append((self.index, (arrays, {**about, "finished": True})))
        self.save_sometimes(lambda: None)

    def save_sometimes(self, capture: Callable[[], Kept | None]) -> None:
        """Write what is kept if the last time was INTERVAL_S ago, with the state of an unfinished computation."""
        if time.perf_counter() - self.saved_s <= INTERVAL_S:
            return
        costs.begin(self.folder, self.origin)
        under_way = capture()
        for index, (arrays, about) in self.waiting + ([(self.index, under_way)] if under_way else []):
            write_model(self._path(index), arrays, about)
        costs.keep(self.folder)
        self.waiting, self.saved_s = [], time.perf_counter()

    def _path(self, index: int) -> Path:
        return self.folder / f"{index:04d}.safetensors"


_open: list[Checkpoint] = []
"""The checkpoint of the run, if it keeps one: the computations lie too deep to hand it down to each."""


@contextlib.contextmanager
def kept(poses: Path, inputs: Sequence[Path], options: Options) -> Iterator[None]:
    """Keep a checkpoint beside `poses` within the block, and delete it when the block has succeeded."""
    checkpoint = Checkpoint(poses, inputs, options)
    _open.append(checkpoint)
    try:
        yield
        shutil.rmtree(checkpoint.folder, ignore_errors=True)
    finally:
        _open.remove(checkpoint)


def array(compute: Callable[[], np.ndarray]) -> np.ndarray:
    """The array that `compute` returns, or the one that is kept of it."""
    if not _open:
        return compute()
    found = _open[-1].begin()
    result = compute() if found is None else found[0]["result"]
    if found is None:
        _open[-1].finished({"result": result}, {})
    return result


def begin() -> Kept | None:
    """Go on to the next computation; what is kept of it, if anything."""
    return _open[-1].begin() if _open else None


def save_sometimes(capture: Callable[[], Kept]) -> None:
    """Write the state of the present computation if the last time was INTERVAL_S ago."""
    if _open:
        _open[-1].save_sometimes(capture)


def finished(capture: Callable[[], Kept]) -> None:
    """Keep the result of the present computation."""
    if _open:
        _open[-1].finished(*capture())


def arrays_of(state: State) -> dict[str, np.ndarray]:
    """A state as arrays by name."""
    return {name: np.asarray(value) for name, value in vars(state).items() if value is not None}


def state_of(arrays: Mapping[str, np.ndarray]) -> State:
    """The state whose `arrays_of` these are."""
    optional = (arrays.get("zoom"), arrays.get("lens"))
    return State(arrays["cam_from_world"], arrays["inverse_depth"], arrays["focal_px"].item(), *optional)


def _fingerprint(inputs: Sequence[Path], options: Options) -> str:
    """A digest of options, code and inputs: of their names, sizes and times, since flow is too large to read."""
    digest = hashlib.sha256(options.model_dump_json().encode() + code_digest("stages.ba").encode())
    for path in inputs:
        for file in sorted(filter(Path.is_file, path.rglob("*"))) if path.is_dir() else [path]:
            about = file.stat()
            digest.update(f"{file.name} {about.st_size} {about.st_mtime_ns}".encode())
    return digest.hexdigest()
