"""A .npz of arrays, some of them too large for memory: these are written one frame at a time. No pickle."""

import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy


@dataclass(frozen=True)
class Stack:
    """An array of a shape [T, ...] and a dtype, given one frame [...] after the other."""

    shape: tuple[int, ...]
    dtype: Any
    frames: Iterable[np.ndarray]


def write_npz(path: Path, arrays: Mapping[str, np.ndarray | Stack]) -> None:
    """Write arrays by name, so that `np.load` reads all of them as arrays."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                if isinstance(array, Stack):
                    _write_stack(file, array)
                else:
                    npy.write_array(file, np.asarray(array), allow_pickle=False)


def _write_stack(file: Any, stack: Stack) -> None:
    kind = np.dtype(stack.dtype)
    about = {"descr": npy.dtype_to_descr(kind), "fortran_order": False, "shape": stack.shape}
    npy.write_array_header_1_0(file, about)
    for frame in stack.frames:
        file.write(np.ascontiguousarray(frame, kind).tobytes())
