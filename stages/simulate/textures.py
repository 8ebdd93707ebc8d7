"""Procedural solid textures: gradient noise with octaves down to the size of a pixel, and patterns.

Natural images have about the same contrast in every octave (power falls as 1 / f^2 in two dimensions), so the contrast
decreases slowly from octave to octave. Octaves finer than two pixels would alias and are left out (Perlin 1985, An
image synthesizer).
"""

import numpy as np
from numba import njit

from stages.shared.threads import spread

PERSISTENCE = 0.78
"""Contrast of an octave relative to the next coarser one."""
ROUGH, BRICKS, PLANKS, STRIPES, STONES, CHECKS = range(6)
GRADIENTS = np.random.default_rng(0).uniform(-1, 1, (256, 3))
PATTERNS = {"rough": ROUGH, "bricks": BRICKS, "planks": PLANKS, "stripes": STRIPES, "stones": STONES, "checks": CHECKS}


@njit(cache=True, inline="always")
def _hash(x: int, y: int, z: int) -> int:
    """A random integer for a lattice point (multiplicative mixing as in Teschner et al. 2003, then avalanche)."""
    h = np.uint32((x * 0x8DA6B343) ^ (y * 0xD8163841) ^ (z * 0xCB1AB31F))
    h = np.uint32((h ^ (h >> 15)) * 0x2C1B3C6D)
    return np.int64(h ^ (h >> 13))  # type: ignore[return-value]


@njit(cache=True, inline="always")
def _slope(x: int, y: int, z: int, fx: float, fy: float, fz: float) -> float:
    """Dot product of the lattice point's random gradient with the offset (fx, fy, fz)."""
    k = _hash(x, y, z) & 255
    return GRADIENTS[k, 0] * fx + GRADIENTS[k, 1] * fy + GRADIENTS[k, 2] * fz


@njit(cache=True)
def noise(x: float, y: float, z: float) -> float:
    """Gradient noise at a point: zero mean, about -1..1, features of size 1."""
    bx, by, bz = np.floor(x), np.floor(y), np.floor(z)
    fx, fy, fz = x - bx, y - by, z - bz
    i, j, k = np.int64(bx), np.int64(by), np.int64(bz)
    sx = fx * fx * fx * (fx * (fx * 6 - 15) + 10)
    sy = fy * fy * fy * (fy * (fy * 6 - 15) + 10)
    sz = fz * fz * fz * (fz * (fz * 6 - 15) + 10)
    a = _slope(i, j, k, fx, fy, fz)
    b = _slope(i, j + 1, k, fx, fy - 1, fz)
    c = _slope(i, j, k + 1, fx, fy, fz - 1)
    d = _slope(i, j + 1, k + 1, fx, fy - 1, fz - 1)
    a += sx * (_slope(i + 1, j, k, fx - 1, fy, fz) - a)
    b += sx * (_slope(i + 1, j + 1, k, fx - 1, fy - 1, fz) - b)
    c += sx * (_slope(i + 1, j, k + 1, fx - 1, fy, fz - 1) - c)
    d += sx * (_slope(i + 1, j + 1, k + 1, fx - 1, fy - 1, fz - 1) - d)
    a += sy * (b - a)
    c += sy * (d - c)
    return 1.6 * (a + sz * (c - a))


@njit(cache=True)
def fractal(x: float, y: float, z: float, footprint: float) -> float:
    """Sum of octaves of noise from size 1 down to the footprint (size of a pixel), standard deviation about 0.6."""
    total, weight, size = 0.0, 1.0, 1.0
    for octave in range(12):
        fade = min(size / footprint - 1.0, 1.0)
        if fade <= 0.0:
            break
        shift = 17.3 * octave
        total += weight * fade * noise(x / size + shift, y / size - shift, z / size + 0.5 * shift)
        size *= 0.5
        weight *= PERSISTENCE
    return total


def fractal_field(points: np.ndarray, footprint: float) -> np.ndarray:
    """Values [n] of `fractal` at points [n, 3]."""
    values = np.empty(len(points))
    spread(_fractal_field, len(points), points, footprint, values)
    return values


@njit(cache=True, nogil=True)
def _fractal_field(first: int, last: int, points: np.ndarray, footprint: float, values: np.ndarray) -> None:
    for n in range(first, last):
        values[n] = fractal(points[n, 0], points[n, 1], points[n, 2], footprint)


@njit(cache=True, inline="always")
def _edge(distance: float, width: float, footprint: float) -> float:
    """1 inside a line of half-width `width`, 0 outside, blurred over the footprint."""
    soft = max(footprint, 0.25 * width)
    return min(max((width - distance) / soft + 0.5, 0.0), 1.0) * min(1.0, 2.0 * width / soft)


@njit(cache=True)
def _bricks(u: float, v: float, footprint: float, aspect: float) -> tuple[float, float]:
    """Tone 0..1 of a brick or plank and visibility 0..1 of the joint, in rows of height 1 / `aspect`."""
    row = np.floor(v * aspect)
    shifted = u + 0.5 * (np.int64(row) & 1) if aspect < 6 else u + 0.37 * row
    column = np.floor(shifted)
    du = min(shifted - column, column + 1 - shifted)
    dv = min(v * aspect - row, row + 1 - v * aspect) / aspect
    tone = np.float64(_hash(np.int64(row), np.int64(column), 5) & 255) / 255.0
    return tone, _edge(min(du, dv), 0.018, footprint)


@njit(cache=True)
def _stones(u: float, v: float, footprint: float) -> tuple[float, float]:
    """Tone 0..1 of the nearest cell and visibility 0..1 of the joint to the second nearest (Worley 1996)."""
    iu, iv = np.int64(np.floor(u)), np.int64(np.floor(v))
    nearest, second, tone = 9.0, 9.0, 0.0
    for j in range(iv - 1, iv + 2):
        for i in range(iu - 1, iu + 2):
            h = _hash(i, j, 9)
            du = i + np.float64(h & 255) / 255.0 - u
            dv = j + np.float64((h >> 8) & 255) / 255.0 - v
            distance = np.sqrt(du * du + dv * dv)
            if distance < nearest:
                nearest, second, tone = distance, nearest, np.float64((h >> 16) & 255) / 255.0
            elif distance < second:
                second = distance
    return tone, _edge(0.5 * (second - nearest), 0.05, footprint)


@njit(cache=True)
def pattern(kind: int, u: float, v: float, footprint: float) -> tuple[float, float]:
    """Tone 0..1 and visibility of joints 0..1 of a pattern at (u, v) in its plane; its features have size 1."""
    if kind == BRICKS:
        return _bricks(u, v, footprint, 2.6)
    if kind == PLANKS:
        return _bricks(u, v, footprint, 7.0)
    if kind == STONES:
        return _stones(u, v, footprint)
    stripe = 0.5 + 0.5 * np.tanh(3.0 * np.sin(2.0 * np.pi * v)) if footprint < 0.4 else 0.5
    if kind == CHECKS:
        across = 0.5 + 0.5 * np.tanh(3.0 * np.sin(2.0 * np.pi * u)) if footprint < 0.4 else 0.5
        return 0.5 * (stripe + across), 0.0
    return stripe, 0.0
