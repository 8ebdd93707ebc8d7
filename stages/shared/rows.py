"""Columns of dense files whose rows are read where they are needed: packed ones, and those of several batches."""

import bisect
import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from stages.shared.columns import array_of, tensor_column_of
from stages.shared.errors import InputError

HELD = 32
"""Rows that are kept after they were read: an edge is asked for several times in turn."""
SHORT_BYTES = 32_000_000
"""Size of the rows, as they are read, up to which all are kept: the flow of a short clip is gone through many times."""
OFTEN_READ_BYTES = 256_000_000
"""The same for stages that go through it many times, and ask for the memory: `motion` twelve times, `ba` three."""
PACKED = b"packed"
"""Key in the metadata of a field whose rows are packed (`packing.pack`); its value is the shape of a row, in JSON."""


class Rows:
    """A column [n, ...], read-only, of which indexing reads the rows that it names, and `np.asarray` all.

    The first index selects rows as in numpy; what follows, slices or numbers, is applied to each of them.

    Attributes:
        packed: the n buffers of packed rows; empty if they are not packed.
        short: whether all rows are kept, up to `short_bytes`, or SHORT_BYTES.
    """

    def __init__(
        self,
        count: int,
        like: np.ndarray,
        read: Callable[[int], np.ndarray],
        packed: Sequence[pa.Buffer] = (),
        short_bytes: int | None = None,
    ) -> None:
        """Of `count` rows, each of the shape and type of `like`."""
        self.shape, self.dtype, self.packed = (count, *like.shape), like.dtype, packed
        self.short = count * like.nbytes <= (SHORT_BYTES if short_bytes is None else short_bytes)
        self._read = lru_cache(count if self.short else HELD)(read)

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return len(self.shape)

    def __len__(self) -> int:
        return self.shape[0]

    def __iter__(self) -> Iterator[np.ndarray]:
        return (self._read(k) for k in range(len(self)))

    def __getitem__(self, key: Any) -> np.ndarray:
        first, *rest = key if isinstance(key, tuple) else (key,)
        if first is Ellipsis:
            return np.asarray(np.asarray(self)[key])
        chosen, inner = np.arange(len(self))[first], tuple(rest)
        if chosen.ndim == 0:
            return np.asarray(self._read(int(chosen))[inner])
        of_row = np.broadcast_to(np.zeros((), self.dtype), self.shape[1:])[inner]
        found = np.empty((*chosen.shape, *of_row.shape), self.dtype)
        for place, k in np.ndenumerate(chosen):
            found[place] = self._read(int(k))[inner]
        return found

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return self[:] if dtype is None else self[:].astype(dtype)

    def forget(self) -> None:
        """Drop the rows that are kept."""
        self._read.cache_clear()


def column_in(
    path: Path,
    field: pa.Field,
    column: pa.ChunkedArray,
    give_back: Callable[[], None],
    short_bytes: int | None,
) -> Any:
    """A column of a mapped file as an array without a copy, or as Rows if it is packed, or images of several batches.

    Args:
        path: the file, for its errors. give_back: gives back the memory of what was read from the file.
        short_bytes: as in `Rows`.
    """
    if PACKED in (field.metadata or {}):
        return _unpacked(path, field, column, give_back, short_bytes)
    if column.num_chunks > 1 and isinstance(column.type, pa.FixedShapeTensorType):
        parts = [array_of(pa.chunked_array([chunk])) for chunk in column.chunks]
        ends = np.cumsum([len(part) for part in parts]).tolist()

        def row(k: int) -> np.ndarray:
            part = bisect.bisect_right(ends, k)
            return np.asarray(parts[part][k - ends[part]])

        return Rows(len(column), parts[0][0], row, short_bytes=short_bytes)
    return array_of(column)


def _unpacked(
    path: Path, field: pa.Field, column: pa.ChunkedArray, give_back: Callable[[], None], short_bytes: int | None
) -> Rows:
    from stages.shared.packing import unpack  # imports OpenCV, which few stages of tables need

    buffers, shape = _buffers(column), tuple(json.loads(field.metadata[PACKED]))
    advice = "run the stage that writes it again"

    def row(k: int) -> np.ndarray:
        try:
            values, finite = unpack(buffers[k], shape)
        except OSError as error:
            raise InputError(path, f"whole rows in '{field.name}'", str(error), advice) from error
        if not finite:
            raise InputError(path, f"finite numbers in '{field.name}'", "NaN or infinity", advice)
        if k % HELD == 0:
            give_back()
        values.setflags(write=False)
        return values

    return Rows(len(buffers), np.broadcast_to(np.float16(0), shape), row, buffers, short_bytes)


def _buffers(column: pa.ChunkedArray) -> list[pa.Buffer]:
    """The rows of a binary column, without a copy."""
    found = []
    for chunk in column.chunks:
        _, ends, content = chunk.buffers()
        at = np.frombuffer(ends, np.int32)[chunk.offset : chunk.offset + len(chunk) + 1].tolist()
        found += [content.slice(begin, end - begin) for begin, end in itertools.pairwise(at)]
    return found


def field_of(name: str, values: Any) -> tuple[pa.Field, pa.Array]:
    """The field and the column of an array [n] or [n, ...], or of a `packing.Packed`."""
    if not hasattr(values, "rows"):
        column = tensor_column_of(np.ascontiguousarray(values))
        return pa.field(name, column.type), column
    ends = np.cumsum([0, *(row.size for row in values.rows)]).astype(np.int32)
    content = pa.py_buffer(b"".join(memoryview(row) for row in values.rows))
    packed = pa.Array.from_buffers(pa.binary(), len(values.rows), [None, pa.py_buffer(ends), content])
    return pa.field(name, pa.binary(), metadata={PACKED: json.dumps(values.shape)}), packed
