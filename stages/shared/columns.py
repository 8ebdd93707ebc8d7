"""Columns of tables and of dense files, Arrow's on one side and numpy's on the other."""

from typing import Any

import numpy as np
import pyarrow as pa


def column_of(values: Any) -> pa.Array:
    """Values (an array [n] or [n, k], a list of n) as a column of a table.

    Arrays of numbers and lists of text go without `pa.array`, which imports pandas for a third of a second.
    """
    if isinstance(values, np.ndarray) and values.dtype.kind in "biuf":
        flat = _numbers(values.ravel())
        return pa.FixedSizeListArray.from_arrays(flat, values.shape[1]) if values.ndim == 2 else flat
    if isinstance(values, list) and values and all(isinstance(value, str) for value in values):
        builder = pa.lib.StringBuilder()
        builder.append_values(values)
        return builder.finish()
    return pa.array(values)


def tensor_column_of(values: np.ndarray) -> pa.Array:
    """An array [n] or [n, ...] as a column of numbers or of fixed-shape tensors, without a copy if it lies in a row."""
    flat = _numbers(values.ravel())
    if values.ndim == 1:
        return flat
    kind = pa.fixed_shape_tensor(flat.type, values.shape[1:])
    storage = pa.FixedSizeListArray.from_arrays(flat, int(np.prod(values.shape[1:])))
    return pa.ExtensionArray.from_storage(kind, storage)


def _numbers(values: np.ndarray) -> pa.Array:
    """Numbers or booleans [n], without a copy if they lie in a row."""
    values = np.ascontiguousarray(values)
    kind = pa.uint8() if values.dtype == bool else pa.from_numpy_dtype(values.dtype)
    array = pa.Array.from_buffers(kind, len(values), [None, pa.py_buffer(values)])
    return array.cast(pa.bool_()) if values.dtype == bool else array


def array_of(column: pa.ChunkedArray) -> np.ndarray:
    """A column as an array: [n], [n, k] for lists, [n, ...] for tensors, without a copy; text and nulls as objects."""
    array = column.combine_chunks() if column.num_chunks != 1 else column.chunk(0)
    if isinstance(array.type, pa.FixedShapeTensorType):
        return np.from_dlpack(array.storage.flatten()).reshape(len(array), *array.type.shape)
    if pa.types.is_fixed_size_list(array.type):
        return np.from_dlpack(array.flatten()).reshape(len(array), array.type.list_size)
    if pa.types.is_string(array.type):
        return np.array(array.to_pylist(), object)
    if array.null_count == 0 and (pa.types.is_integer(array.type) or pa.types.is_floating(array.type)):
        return np.from_dlpack(array)
    return np.asarray(array.to_numpy(zero_copy_only=False))
