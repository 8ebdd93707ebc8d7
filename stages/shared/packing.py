"""Images in half precision, packed without loss to less than half of their size.

Neighbouring values of flow are alike. A value, as a whole number that grows with it, is predicted from the three
neighbours before it by the plane through them; what remains is small. Its low and its high bytes, each together, are
compressed by Zstandard's fastest level, which finds few repetitions there but short codes for frequent bytes.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numba
import numpy as np
import pyarrow as pa

LEVEL = 1


class Packed(NamedTuple):
    """Rows of a column [n, h, w] or [n, h, w, c] of half precision, each packed by `pack`.

    Attributes:
        rows: n buffers; shape: that of a row.
    """

    rows: Sequence[pa.Buffer]
    shape: tuple[int, ...]


def pack(values: np.ndarray) -> pa.Buffer:
    """An image [h, w] or [h, w, c] float16 as a compressed buffer; NaN and infinity are kept like numbers."""
    bits = np.ascontiguousarray(values, np.float16).view(np.int16)
    planes = np.empty((2, *bits.shape[2:], *bits.shape[:2]), np.uint8)
    h, w = bits.shape[:2]
    _to_planes(bits.reshape(h, w, -1), planes.reshape(2, -1, h, w))
    return pa.Codec("zstd", LEVEL).compress(planes)


def unpack(buffer: pa.Buffer, shape: tuple[int, ...]) -> tuple[np.ndarray, bool]:
    """The image [h, w] or [h, w, c] float16 in a buffer that `pack` made, and whether all its numbers are finite.

    Raises:
        OSError: if the buffer is damaged.
    """
    size = 2 * int(np.prod(shape))
    found = np.frombuffer(pa.Codec("zstd").decompress(buffer, size), np.uint8)
    if len(found) != size:
        raise OSError(f"{len(found)} of {size} bytes in a packed row")
    bits = np.empty(shape, np.int16)
    h, w = shape[:2]
    finite = _from_planes(found.reshape(2, -1, h, w), bits.reshape(h, w, -1))
    return bits.view(np.float16), bool(finite)


@numba.njit(cache=True, nogil=True)
def _to_planes(bits, planes):  # type: ignore[no-untyped-def]
    h, w, channels = bits.shape
    mask = np.int64(0xFFFF)
    before = np.zeros((channels, w), np.int64)
    for y in range(h):
        for c in range(channels):
            left, corner = np.int64(0), np.int64(0)
            for x in range(w):
                value = np.int64(bits[y, x, c])
                if value < 0:  # the sign bit of a negative number: the larger its magnitude, the smaller it is
                    value = ~(value & 0x7FFF)
                step = (value - left - before[c, x] + corner) & mask
                small = (step << 1) & mask if step < 0x8000 else ((~step & mask) << 1) | 1
                planes[0, c, y, x], planes[1, c, y, x] = small & 255, small >> 8
                left, corner, before[c, x] = value, before[c, x], value


@numba.njit(cache=True, nogil=True)
def _from_planes(planes, bits):  # type: ignore[no-untyped-def]
    h, w, channels = bits.shape
    before, steps = np.zeros((channels, w), np.int16), np.empty(w, np.int16)
    special = 0
    for y in range(h):
        for c in range(channels):
            for x in range(w):  # three loops: all but the running sum take many values at a time
                small = np.uint16(planes[0, c, y, x] | (np.uint16(planes[1, c, y, x]) << np.uint16(8)))
                steps[x] = np.int16(np.int16(small >> np.uint16(1)) ^ np.int16(-np.int16(small & np.uint16(1))))
            total = np.int16(0)
            for x in range(w):
                total = np.int16(total + steps[x])
                steps[x] = total
            for x in range(w):
                value = np.int16(before[c, x] + steps[x])
                before[c, x] = value
                sign = np.int16(value >> np.int16(15))
                value = np.int16((value ^ sign) | (sign & np.int16(-0x8000)))
                bits[y, x, c] = value
                special += np.int16(value & np.int16(0x7C00)) == np.int16(0x7C00)
    return special == 0
