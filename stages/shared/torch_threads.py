"""Torch on one thread. This is not part of `threads`, which stages without torch import."""

import contextlib
from collections.abc import Iterator

import torch


@contextlib.contextmanager
def one_torch_thread() -> Iterator[None]:
    """Run torch on one thread, as a block or a decorator: the rounding of its sums depends on the number of threads.

    For small tensors, which gain nothing from more threads. Compiled kernels keep their threads.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
