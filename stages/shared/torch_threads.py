"""Torch on one thread, where more would round otherwise. Apart from `threads`, which stages without torch import."""

import contextlib
from collections.abc import Iterator

import torch


@contextlib.contextmanager
def one_torch_thread() -> Iterator[None]:
    """Torch on one thread, as block or decorator: with more, its sums and products round by their number.

    For tensors that are too small for more threads to pay; compiled kernels keep theirs.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
