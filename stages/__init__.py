"""motionsplat: one folder per stage; stages exchange files only."""

import os
import sys
import time
from pathlib import Path

START_S = time.perf_counter()
"""Start of this process; reported seconds include the imports."""
KERNEL_TYPES = 2
"""Raise this number when a named tuple that kernels take is renamed or moved. Numba reads the index of its compiled
code, which contains these types, before it compares the age of the source: an unknown name in it is an error."""

# libgomp and OpenBLAS read these once, when they load, hence before numpy or torch. Spinning OpenMP threads slow down
# jobs that share cores several times, as does a multi-threaded BLAS below our own threads. Snakemake sets
# OMP_NUM_THREADS from `threads:`.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ.setdefault("OMP_NUM_THREADS", str(os.cpu_count() or 1))
os.environ.setdefault("NUMBA_CACHE_DIR", str(Path(sys.prefix) / f"numba_cache_{KERNEL_TYPES}"))


def kernels_compiled() -> bool:
    """Whether compiled kernels are cached on this machine; otherwise the first run compiles them."""
    return next(Path(os.environ["NUMBA_CACHE_DIR"]).glob("*/*.nbc"), None) is not None
