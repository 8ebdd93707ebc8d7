"""The files that stages exchange: one reader and one atomic writer per kind, with metadata, never pickle.

Tables are Parquet; dense per-row tensors are Arrow IPC with fixed-shape-tensor columns (memory-mapped on reading);
models are safetensors; the rest is JSON, and images (`stages.shared.images`). `metadata` carries units and options; the
writers add `format_version` and the digest of the code that wrote the file.
"""

import contextlib
import json
import mmap
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from stages.shared.atomic import atomic
from stages.shared.columns import array_of, column_of
from stages.shared.digest import code_digest
from stages.shared.errors import InputError
from stages.shared.finite import is_finite
from stages.shared.log import logger
from stages.shared.rows import Rows, column_in, field_of

ReadT = TypeVar("ReadT")
FORMAT_VERSION = 1
ROWS_AT_ONCE = 64
"""Rows of a mapped file that are held while it is checked."""
OS_ERROR = re.compile(r"\(os error (\d+)\)")


def write_table(path: Path, columns: Mapping[str, Any], metadata: Mapping[str, Any] | None = None) -> None:
    """Write columns of equal length (arrays [n], [n, k], lists of str) as Parquet."""
    table = pa.table({name: column_of(values) for name, values in columns.items()})
    with atomic(path) as partial:
        pq.write_table(table.replace_schema_metadata(_encode(metadata)), partial)


def read_table(path: Path) -> dict[str, np.ndarray]:
    """Read a Parquet table into arrays: [n] for scalars, [n, k] for lists; text as objects, nulls as NaN or as None."""
    table = _checked(path, "a Parquet table", lambda: pq.ParquetFile(path).read())
    return {name: array_of(table[name]) for name in table.column_names}


DenseWriter = Callable[[Mapping[str, Any]], None]


def write_dense(path: Path, columns: Mapping[str, Any], metadata: Mapping[str, Any] | None = None) -> None:
    """Write arrays [n] and [n, ...], or `packing.Packed`, row by row as Arrow IPC with fixed-shape-tensor columns."""
    with dense_writer(path, metadata) as write:
        write(columns)


@contextlib.contextmanager
def dense_writer(
    path: Path, metadata: Mapping[str, Any] | None = None
) -> Iterator[Callable[[Mapping[str, Any]], None]]:
    """A function that appends rows to a dense file, which gets its name when the block ends: one record batch per call.

    Every call passes the same columns, as `write_dense` takes them; there must be one.
    """
    with contextlib.ExitStack() as stack:
        sink = pa.OSFile(str(stack.enter_context(atomic(path))), "wb")
        stack.enter_context(sink)
        writers: list[pa.RecordBatchFileWriter] = []

        def write(columns: Mapping[str, Any]) -> None:
            fields, arrays = zip(*(field_of(name, values) for name, values in columns.items()), strict=True)
            schema = pa.schema(fields).with_metadata(_encode(metadata))
            if not writers:
                writers.append(stack.enter_context(pa.ipc.new_file(sink, schema)))
            writers[0].write_batch(pa.record_batch(list(arrays), schema=schema))

        yield write


class Dense(dict[str, np.ndarray]):
    """The columns of a dense file, [n] and [n, ...], read-only, mapped from it where they come from one.

    Images that are packed, or stand in several record batches, are `Rows`: arrays as far as indexing goes.
    """

    def __init__(self, columns: Mapping[str, np.ndarray], mapped: mmap.mmap | None = None) -> None:
        super().__init__(columns)
        self._mapped = mapped

    def release(self, keep_short: bool = True) -> None:
        """Give back the memory of what was read; it is read from the file again where it is used again.

        The pages of a mapped file count as memory of the process until then, and as used memory of its control group.

        Args:
            keep_short: keep the rows that were unpacked of columns that are short as a whole; not for one of many
                files, which are not short together.
        """
        self.give_back()
        for values in self.values():
            if isinstance(values, Rows) and not (keep_short and values.short):
                values.forget()

    def give_back(self) -> None:
        """Like `release`, but rows that were unpacked a moment ago are kept."""
        if self._mapped is not None:
            self._mapped.madvise(mmap.MADV_DONTNEED)


def read_dense(path: Path, short_bytes: int | None = None) -> Dense:
    """Memory-map an Arrow IPC file: read-only arrays [n] and [n, ...] without a copy, or `Rows`, read one by one.

    Args:
        short_bytes: size up to which all rows of a column are kept once they are read; None: `rows.SHORT_BYTES`.

    Raises:
        InputError: if it is not an Arrow IPC file, or holds NaN or infinity; of packed rows when they are read.
    """
    mapped = _checked(path, "an Arrow IPC file", lambda: _mapped(path))
    table = _checked(path, "an Arrow IPC file", lambda: pa.ipc.open_file(pa.py_buffer(mapped)).read_all())
    columns, give_back = Dense({}, mapped), partial(mapped.madvise, mmap.MADV_DONTNEED)
    for name in table.column_names:
        values = column_in(path, table.schema.field(name), table[name], give_back, short_bytes)
        for first in range(0, 0 if isinstance(values, Rows) and values.packed else len(values), ROWS_AT_ONCE):
            refuse_infinite(path, {name: values[first : first + ROWS_AT_ONCE]})
            columns.release()
        columns[name] = values
    return columns


def _mapped(path: Path) -> mmap.mmap:
    with path.open("rb") as file:
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)


def refuse_infinite(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Refuse columns of a file with values that are not finite: kernels assume finite numbers.

    Raises:
        InputError: names the file and the first such column.
    """
    for name, values in columns.items():
        if not is_finite(values):
            advice = "run the stage that writes it again"
            raise InputError(path, f"finite numbers in '{name}'", "NaN or infinity", advice)


def read_metadata(path: Path) -> dict[str, Any]:
    """The metadata of a table (.parquet), dense file (.arrow) or model (.safetensors)."""
    if path.suffix == ".safetensors":
        raw = _checked(path, "a safetensors file", lambda: _model_metadata(path))
    elif path.suffix == ".parquet":
        raw = _checked(path, "a Parquet table", lambda: pq.read_schema(path).metadata)
    else:
        raw = _checked(path, "an Arrow file", lambda: pa.ipc.open_file(pa.memory_map(str(path))).schema.metadata)
    texts = {key.decode(): value for key, value in (raw or {}).items() if not key.startswith(b"ARROW")}
    read = _checked(path, "metadata in JSON", lambda: {key: json.loads(value) for key, value in texts.items()})
    return dict(read)


def unless_damaged(read: Callable[[], ReadT]) -> ReadT | None:
    """What `read` gives of the files that a killed run has left; None, and a line in the log, if they are damaged.

    A power cut may leave them so: nothing waits for the disk.
    """
    try:
        return read()
    except InputError as damaged:
        logger.warning("%s is damaged: what a killed run had left there is computed again", damaged.subject)
        return None


def write_model(path: Path, tensors: Mapping[str, np.ndarray], metadata: Mapping[str, Any] | None = None) -> None:
    """Write arrays of any shape, by name, as safetensors.

    Raises:
        OSError: if the disk is full, for example, which safetensors tells in words alone.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import save_file

    text = {key.decode(): value.decode() for key, value in _encode(metadata).items()}
    with atomic(path) as partial:
        try:
            save_file({name: np.ascontiguousarray(value) for name, value in tensors.items()}, partial, metadata=text)
        except SafetensorError as error:
            number = OS_ERROR.search(str(error))
            if number is None:
                raise
            raise OSError(int(number[1]), os.strerror(int(number[1]))) from error


def read_model(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of a safetensors file, by name.

    Raises:
        InputError: if it is not a safetensors file, or holds NaN or infinity.
    """
    from safetensors.numpy import load_file

    tensors = dict(_checked(path, "a safetensors file", lambda: load_file(path)))
    refuse_infinite(path, tensors)
    return tensors


def _model_metadata(path: Path) -> dict[bytes, bytes]:
    from safetensors import safe_open

    with safe_open(path, framework="numpy") as file:
        return {key.encode(): value.encode() for key, value in (file.metadata() or {}).items()}


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON object, with `format_version` as its first key."""
    with atomic(path) as partial:
        partial.write_text(json.dumps({"format_version": FORMAT_VERSION, **content}, indent=2) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object."""
    content: dict[str, Any] = _checked(path, "a JSON object", lambda: json.loads(path.read_text()))
    return content


def _checked(path: Path, expected: str, read: Any) -> Any:
    try:
        return read()
    except (OSError, ValueError, pa.ArrowInvalid) as error:
        found = str(error).splitlines()[0]
        raise InputError(path, expected, found, "run the stage that writes it again") from error
    except Exception as error:
        if type(error).__name__ != "SafetensorError":
            raise
        raise InputError(path, expected, str(error), "run the stage that writes it again") from error


def _encode(metadata: Mapping[str, Any] | None) -> dict[bytes, bytes]:
    main = sys.modules.get("__main__")
    spec = getattr(main, "__spec__", None)
    stage = spec.name if spec and spec.name.startswith("stages.") else None
    stamp = {"format_version": FORMAT_VERSION, "code": code_digest(stage) if stage else None, **(metadata or {})}
    return {key.encode(): json.dumps(value).encode() for key, value in stamp.items()}
