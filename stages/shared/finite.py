"""Checks for NaN and infinity: compiled kernels assume finite input and return garbage otherwise."""

import numpy as np

HALF_EXPONENT = np.uint16(0x7C00)
VALUES_AT_ONCE = 1 << 16


def is_finite(values: np.ndarray) -> bool:
    """Whether an array [n, ...] holds neither NaN nor infinity; true for integers, booleans and text."""
    if values.dtype.kind != "f":
        return True
    # Some rows at a time: allocating a mask for the whole array would take longer than the test, as would testing each
    # row of three numbers. For half precision the bits are tested, which is faster than converting each number.
    rows = values if values.ndim > 1 else values[None]
    step = max(1, VALUES_AT_ONCE // max(rows[:1].size, 1))
    parts = (rows[k : k + step] for k in range(0, len(rows), step))
    if values.dtype == np.float16:
        return all(bool(((part.view(np.uint16) & HALF_EXPONENT) != HALF_EXPONENT).all()) for part in parts)
    return all(bool(np.isfinite(part).all()) for part in parts)


def require_finite(**arrays: np.ndarray) -> None:
    """Check the arguments of a kernel.

    Raises:
        ValueError: names the first array that holds NaN or infinity.
    """
    for name, values in arrays.items():
        if not is_finite(values):
            raise ValueError(f"{name}: expected finite numbers, found NaN or infinity")
