"""Quaternions wxyz as tuples in numba: allocating arrays inside the loops would cost more than the arithmetic."""

from typing import Any

import numpy as np
from numba import njit

FAST = {"cache": True, "nogil": True, "fastmath": {"contract", "nsz", "arcp"}, "error_model": "numpy"}
"""Fused multiply-add and reciprocals are allowed; the flags that assume no infinities and no NaN are not set."""
ONE: Any = np.float32(1)  # adding a Python integer to a float32 would give float64
Quaternion = tuple[float, float, float, float]
Vector = tuple[float, float, float]
Rows = tuple[Vector, Vector, Vector]


@njit(inline="always", **FAST)
def product(a: Quaternion, b: Quaternion) -> Quaternion:
    """Hamilton product."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@njit(inline="always", **FAST)
def row(quats: np.ndarray, n: int) -> Quaternion:
    """Row n of quats [N, 4]."""
    return quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3]


@njit(inline="always", **FAST)
def dot(a: Quaternion, b: Quaternion) -> float:
    """Inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]


@njit(inline="always", **FAST)
def conjugate(q: Quaternion) -> Quaternion:
    """The inverse of a unit quaternion."""
    return q[0], -q[1], -q[2], -q[3]


@njit(inline="always", **FAST)
def unit(q: Quaternion) -> tuple[Quaternion, float]:
    """q / |q| and |q|. Dividing by the largest entry first avoids underflow. Zero stays zero and gets length one."""
    largest = max(abs(q[0]), abs(q[1]), abs(q[2]), abs(q[3]))
    if largest == 0:
        return q, largest + ONE
    scaled = (q[0] / largest, q[1] / largest, q[2] / largest, q[3] / largest)
    length = np.sqrt(dot(scaled, scaled))
    return (scaled[0] / length, scaled[1] / length, scaled[2] / length, scaled[3] / length), largest * length


@njit(inline="always", **FAST)
def unit_adjoint(unit: Quaternion, length: float, g: Quaternion) -> Quaternion:
    """Gradient of q from the gradient g of u = q / |q|: (g - u <u, g>) / |q|."""
    along = dot(unit, g)
    return (
        (g[0] - unit[0] * along) / length,
        (g[1] - unit[1] * along) / length,
        (g[2] - unit[2] * along) / length,
        (g[3] - unit[3] * along) / length,
    )


@njit(**FAST)
def rotation(quat: Quaternion) -> Rows:
    """Rotation matrix of a unit quaternion."""
    w, x, y, z = quat
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@njit(**FAST)
def rotation_adjoint(quat: Quaternion, g: Rows) -> Quaternion:
    """Gradient of the unit quaternion from the gradient g of its rotation matrix."""
    w, x, y, z = quat
    a, b, c = g[0][1] + g[1][0], g[0][2] + g[2][0], g[1][2] + g[2][1]
    d, e, f = g[2][1] - g[1][2], g[0][2] - g[2][0], g[1][0] - g[0][1]
    return (
        2 * (x * d + y * e + z * f),
        2 * (y * a + z * b + w * d - 2 * x * (g[1][1] + g[2][2])),
        2 * (x * a + z * c + w * e - 2 * y * (g[0][0] + g[2][2])),
        2 * (x * b + y * c + w * f - 2 * z * (g[0][0] + g[1][1])),
    )
