"""Maps of many frames, which do not fit into memory together: computed when asked for, packed, or kept in a file."""

import mmap
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

ItemT = TypeVar("ItemT")
ItemT_co = TypeVar("ItemT_co", covariant=True)
SAMPLED = 64
"""One value in this many is looked at to find out about where the median lies."""


class Frames(Protocol[ItemT_co]):
    """What F frames show, one after the other: an array [F, ...], or one of the classes below."""

    def __len__(self) -> int:
        """F."""

    def __getitem__(self, f: Any, /) -> ItemT_co:
        """That of frame f, 0..F-1."""


class Computed(Generic[ItemT]):
    """What `compute` gives for each of `count` frames, whenever it is asked for.

    The first `most` of them are kept. Which ones does not matter where all are asked for in turn or in random order;
    there those used last would be found again less often.
    """

    def __init__(self, count: int, compute: Callable[[int], ItemT], most: int = 0) -> None:
        self._count, self._compute, self._most = count, compute, most
        self._kept: dict[int, ItemT] = {}

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, f: int) -> ItemT:
        if not 0 <= f < self._count:
            raise IndexError(f)
        if f in self._kept:
            return self._kept[f]
        item = self._compute(f)
        if len(self._kept) < self._most:
            self._kept[f] = item
        return item


class PackedMasks(Mapping[int, np.ndarray]):
    """Masks [H, W] bool by number, eight pixels in a byte."""

    def __init__(self, masks: Iterable[tuple[int, np.ndarray]] = ()) -> None:
        self._bits: dict[int, tuple[np.ndarray, tuple[int, ...]]] = {}
        for number, mask in masks:
            self.add(number, mask)

    def add(self, number: int, mask: np.ndarray) -> None:
        """Keep a mask [H, W] bool under a number."""
        self._bits[number] = np.packbits(mask), mask.shape

    def __getitem__(self, number: int) -> np.ndarray:
        bits, shape = self._bits[number]
        return np.unpackbits(bits, count=shape[0] * shape[1]).view(bool).reshape(shape)

    def __iter__(self) -> Iterator[int]:
        return iter(self._bits)

    def __len__(self) -> int:
        return len(self._bits)


class StoredFrames:
    """Arrays of one shape and type, one per frame, read-only, in a nameless file of which only one is held at a time.

    The file takes its room on the disk until the object is gone; a killed process leaves none.
    """

    def __init__(self, frames: Iterable[np.ndarray], folder: Path | None = None) -> None:
        self._count, self._current = 0, -1
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            for frame in frames:
                self._shape, self._type = frame.shape, frame.dtype
                file.write(np.ascontiguousarray(frame).data)
                self._count += 1
            file.flush()
            self._mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, f: int) -> np.ndarray:
        if not 0 <= f < self._count:
            raise IndexError(f)
        if f != self._current:
            self._mapped.madvise(mmap.MADV_DONTNEED)  # an earlier frame is read again where it is still in use
            self._current = f
        size = int(np.prod(self._shape))
        flat = np.frombuffer(self._mapped, self._type, size, f * size * self._type.itemsize)
        return flat.reshape(self._shape)


def median(frames: Frames[np.ndarray]) -> float:
    """The median of all values of frames, which numpy would copy: exact, from those near that of a sample."""
    sample = np.concatenate([np.ravel(frames[f])[::SAMPLED] for f in range(len(frames))])
    found = _middle(frames, *np.quantile(sample, [0.48, 0.52]))
    return float(np.mean(found if len(found) else _middle(frames, -np.inf, np.inf)))


def _middle(frames: Frames[np.ndarray], low: float, high: float) -> np.ndarray:
    """The two values in the middle of all, which may be the same one; none if they are not within low..high."""
    below, count, near = 0, 0, []
    for f in range(len(frames)):
        values = frames[f]
        below += int((values < low).sum())
        count += values.size
        near.append(values[(values >= low) & (values <= high)])
    inside = np.concatenate(near)
    ranks = [(count - 1) // 2 - below, count // 2 - below]
    if ranks[0] < 0 or ranks[1] >= len(inside):
        return inside[:0]
    return np.asarray(np.partition(inside, ranks)[ranks])
