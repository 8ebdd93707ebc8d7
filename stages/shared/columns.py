"""Columns of tables and of dense files, Arrow's on one side and numpy's on the other."""

from typing import Any

import numpy as np
import pyarrow as pa


def column_of(values: Any) -> pa.Array:
    """Values (an array [n] or [n, k], a list of n with None where there is none) as a column of a table.

    Arrays of numbers, and lists of numbers or of text, go without `pa.array`, which imports pandas for a third of a
    second.
    """
    if isinstance(values, np.ndarray) and values.dtype.kind in "biuf":
        flat = _numbers(values.ravel())
        return pa.FixedSizeListArray.from_arrays(flat, values.shape[1]) if values.ndim == 2 else flat
    kinds = {type(value) for value in values if value is not None} if isinstance(values, list) else {object}
    if not kinds:
        return pa.Array.from_buffers(pa.null(), len(values), [None])
    if kinds == {str}:
        builder = pa.lib.StringBuilder()
        builder.append_values(values)
        return builder.finish()
    exact = kinds <= {int, float, np.float64} and all(abs(v) <= 2**53 for v in values if type(v) is int)
    if kinds == {bool} or exact:
        filled = np.array([0 if value is None else value for value in values], None if kinds != {bool} else bool)
        known = np.array([value is not None for value in values])
        return _numbers(filled, None if known.all() else known)
    return pa.array(values)


def tensor_column_of(values: np.ndarray) -> pa.Array:
    """An array [n] or [n, ...] as a column of numbers or of fixed-shape tensors, without a copy if it lies in a row."""
    flat = _numbers(values.ravel())
    if values.ndim == 1:
        return flat
    kind = pa.fixed_shape_tensor(flat.type, values.shape[1:])
    storage = pa.FixedSizeListArray.from_arrays(flat, int(np.prod(values.shape[1:])))
    return pa.ExtensionArray.from_storage(kind, storage)


def _numbers(values: np.ndarray, known: np.ndarray | None = None) -> pa.Array:
    """Numbers or booleans [n], without a copy if they lie in a row; nulls where they are not `known` [n]."""
    values = np.ascontiguousarray(values)
    valid = None if known is None else pa.py_buffer(np.packbits(known, bitorder="little"))
    content = pa.py_buffer(np.packbits(values, bitorder="little") if values.dtype == bool else values)
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), [valid, content])


def _values(lists: pa.FixedSizeListArray) -> np.ndarray:
    """The numbers of lists without null, one after the other; `flatten` would import pyarrow.compute for it."""
    size = lists.type.list_size
    return np.from_dlpack(lists.values.slice(lists.offset * size, len(lists) * size))


def array_of(column: pa.ChunkedArray) -> np.ndarray:
    """A column as an array: [n], [n, k] for lists, [n, ...] for tensors, without a copy.

    Text is objects; nulls are NaN, or None among objects.
    """
    array = column.combine_chunks() if column.num_chunks != 1 else column.chunk(0)
    if isinstance(array.type, pa.FixedShapeTensorType):
        return _values(array.storage).reshape(len(array), *array.type.shape)
    if pa.types.is_fixed_size_list(array.type):
        return _values(array).reshape(len(array), array.type.list_size)
    whole, real = pa.types.is_integer(array.type), pa.types.is_floating(array.type)
    if array.null_count == 0 and (whole or real):
        return np.from_dlpack(array)
    if pa.types.is_boolean(array.type) and array.null_count == 0:
        return np.array(array.to_pylist(), bool)
    if any(of(array.type) for of in (pa.types.is_string, pa.types.is_boolean, pa.types.is_null)):
        return np.array(array.to_pylist(), object)
    if whole or pa.types.is_float64(array.type):
        return np.array([np.nan if value is None else value for value in array.to_pylist()], float)
    return np.asarray(array.to_numpy(zero_copy_only=False))  # imports pandas
