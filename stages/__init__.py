"""motionsplat: one folder per stage; stages meet only in the files they read and write."""

import os
import sys
import time
from pathlib import Path

START_S = time.perf_counter()
"""When this process began its stage; the reported seconds include the imports."""
KERNEL_TYPES = 2
"""Raise it when a named tuple that kernels take is renamed or moved. Numba reads the index of its compiled code,
with these types in it, before it compares the age of the source: an index that holds an old name is an error."""

# Read once, when libgomp and OpenBLAS load, hence before numpy or torch:
# spinning OpenMP threads cost 2-20x when two jobs share two cores, and a multi-threaded BLAS
# below our own threads costs 5-10x. Snakemake sets OMP_NUM_THREADS from `threads:`.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ.setdefault("OMP_NUM_THREADS", str(os.cpu_count() or 1))
os.environ.setdefault("NUMBA_CACHE_DIR", str(Path(sys.prefix) / f"numba_cache_{KERNEL_TYPES}"))


def kernels_compiled() -> bool:
    """Whether this machine keeps compiled kernels already: a run that finds none compiles them, once."""
    return next(Path(os.environ["NUMBA_CACHE_DIR"]).glob("*/*.nbc"), None) is not None
