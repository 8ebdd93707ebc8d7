"""Files and folders that appear whole or not at all."""

import contextlib
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

from stages.shared.errors import InputError

SNAKEMAKE_STAMP = ".snakemake_timestamp"
"""File that Snakemake writes into a folder that is the output of a job."""


@contextlib.contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """A temporary path beside the file `path`, which it replaces only if the block succeeds.

    Raises:
        InputError: if `path` is a folder.
    """
    if path.is_dir():
        raise InputError(path, "a file to write", "a folder", "choose another name")
    with _replacing(path) as partial:
        yield partial


@contextlib.contextmanager
def atomic_folder(path: Path, writes: Iterable[str]) -> Iterator[Path]:
    """Like `atomic`, for a folder: it is created empty and replaces an earlier folder with all its files.

    Args:
        writes: patterns of the files that the caller writes, relative to the folder, as in "test/frame_*.png".

    Raises:
        InputError: if the earlier folder holds files that match no pattern: they would be lost.
    """
    _refuse_foreign(path, writes)
    with _replacing(path) as partial:
        partial.mkdir()
        yield partial


def copy(source: Path, target: Path) -> None:
    """Copy a file, `atomic` as any that is written."""
    with atomic(target) as partial:
        shutil.copyfile(source, partial)


def copy_folder(source: Path, target: Path, writes: Iterable[str]) -> None:
    """Copy the files of a folder that match the patterns `writes`, relative to it, as `atomic_folder` writes them."""
    patterns = tuple(writes)
    with atomic_folder(target, patterns) as partial:
        for file in (file for pattern in patterns for file in source.glob(pattern)):
            copied = partial / file.relative_to(source)
            copied.parent.mkdir(exist_ok=True)
            shutil.copyfile(file, copied)


def _refuse_foreign(path: Path, writes: Iterable[str]) -> None:
    advice = "choose another folder, or empty it yourself"
    if path.exists() and not path.is_dir():
        raise InputError(path, "a folder to write", "a file", advice)
    own = {file for pattern in (*writes, SNAKEMAKE_STAMP) for file in path.glob(pattern)}
    for file in path.rglob("*"):
        if file not in own and (file.is_symlink() or not file.is_dir()):
            expected = "a folder that is new, is empty or holds earlier output alone"
            raise InputError(path, expected, f"'{file.relative_to(path)}' in it", advice)


@contextlib.contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    path.parent.mkdir(parents=True, exist_ok=True)
    partial, old = (path.with_name(f".{path.name}.{kind}") for kind in ("partial", "replaced"))
    _remove(partial)
    try:
        yield partial
        if path.is_dir():  # moved aside first: a kill during the deletion must not leave half of it under its name
            _remove(old)
            path.replace(old)
        partial.replace(path)
        if old.is_dir():
            _remove(old)
    finally:
        _remove(partial)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
