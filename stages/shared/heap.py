"""How the C library keeps memory that is freed."""

import ctypes

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Parameters of glibc's mallopt (malloc.h)."""
KEPT_BYTES, MOST_BYTES = 1 << 30, 1 << 25
"""Size up to which freed arrays are kept; where glibc refuses it, its DEFAULT_MMAP_THRESHOLD_MAX (man mallopt)."""


def keep_freed_memory() -> bool:
    """Let this process keep the memory of freed arrays up to KEPT_BYTES for its next ones; whether it does.

    By default glibc hands every larger array back to the system when it is freed, and the kernel clears each page again
    when the next array touches it. A loop that makes the same arrays over and over pays for that in every turn. Where
    the C library knows no such parameters, as on macOS, nothing happens. Setting either ends glibc's own adaptation of
    the first, so the second is set only where the first was taken.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    taken = any(mallopt(M_MMAP_THRESHOLD, size) for size in (KEPT_BYTES, MOST_BYTES))
    return bool(taken and mallopt(M_TRIM_THRESHOLD, KEPT_BYTES))
