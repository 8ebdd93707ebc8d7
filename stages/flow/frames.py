"""Images of the frames of a clip, made when they are asked for: those of a thousand frames do not stay in memory."""

from collections.abc import Callable, Iterator
from functools import lru_cache

import numpy as np

from stages.shared.threads import threaded

BLOCK = 8
"""Frames that are worked on together: enough for as many threads, and what a killed run does again at most."""
HELD = 160
"""Images that are kept: those of the frames that a long edge and the search for it span, and some more."""


class Images:
    """One image per frame, indexed as an array of them would be; the last HELD are kept."""

    def __init__(self, T: int, make: Callable[[int], np.ndarray], held: int = HELD) -> None:
        self.T, self._made = T, lru_cache(held)(make)

    def __len__(self) -> int:
        return self.T

    def __getitem__(self, k: int) -> np.ndarray:
        return self._made(k)

    def mapped(self, function: Callable[[np.ndarray], np.ndarray]) -> Iterator[np.ndarray]:
        """The function's results for all images, in order, computed on all threads, a block at a time."""
        for frames in blocks(self.T):
            yield from threaded(lambda k: function(self[k]), frames)


def blocks(T: int) -> list[range]:
    """The runs of BLOCK frames."""
    return [range(first, min(first + BLOCK, T)) for first in range(0, T, BLOCK)]
