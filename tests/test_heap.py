"""Memory that is freed and taken again: no page is cleared a second time."""

import ctypes
import subprocess
import sys

import pytest
from conftest import REPO

CODE = """
import ctypes, resource, numpy as np
from stages.shared.heap import keep_freed_memory
{first}
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(10):
        np.empty(30_000_000, np.uint8)[::4096] = 1
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
faults()
print(faults())
"""


def faults(first: str) -> int:
    """Page faults of ten arrays of 30 MB, one after the other, in a process that has had such arrays before."""
    command = [sys.executable, "-c", CODE.format(first=first)]
    return int(subprocess.run(command, check=True, cwd=REPO, capture_output=True, text=True).stdout)


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="the C library has no mallopt")
def test_freed_memory_is_taken_again_without_page_faults() -> None:
    assert faults("assert keep_freed_memory()") < 100
    assert faults("from stages.shared.heap import M_MMAP_THRESHOLD as m; ctypes.CDLL(None).mallopt(m, 1 << 17)") > 1000
