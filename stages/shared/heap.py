"""How the C library keeps memory that is freed."""

import ctypes

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Parameters of glibc's mallopt (malloc.h)."""
KEPT_BYTES = 1 << 30


def keep_freed_memory() -> None:
    """Let this process keep up to KEPT_BYTES of freed memory for its next arrays.

    By default glibc hands every larger array back to the system when it is freed, and the kernel clears each page again
    when the next array touches it. A loop that makes the same arrays over and over pays for that in every turn. Where
    the C library knows no such parameters, as on macOS, nothing happens.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        for parameter in (M_TRIM_THRESHOLD, M_MMAP_THRESHOLD):
            mallopt(parameter, KEPT_BYTES)
