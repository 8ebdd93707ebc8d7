"""Gaussian splats as .spz, version 3 (https://github.com/nianticlabs/spz): a tenth of the size of a PLY.

A gzip stream: a header of 16 bytes, then, each for all Gaussians together, positions, opacities, colours, scales,
rotations and the other coefficients of the spherical harmonics. The world has OpenGL axes (x right, y up, z backward).
"""

import gzip
import struct
from pathlib import Path

import numpy as np

from stages.shared.atomic import atomic

MAGIC, VERSION = 0x5053474E, 3
POSITION_BITS, MAX_FRACTION_BITS = 23, 20
"""Bits of a coordinate without its sign, and at most so many of them after the point."""
COLOUR_SCALE = 0.15
LOG_SCALE_STEPS, LOG_SCALE_ZERO = 16, 10
SH_STEPS = 128
SH_BUCKETS = (8, 16, 16)
"""Steps that are merged into one, for the coefficients of degree 1, 2 and 3, as the reference encoder does."""
ROTATION_STEPS = 511
FLIP = np.array([1.0, -1.0, -1.0])
"""Turns OpenCV axes into OpenGL's, for positions and for the vector part of quaternions alike."""
SH_FLIP = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1.0])
"""The same for the harmonics of degree 1 to 3, by the number of factors y and z in each."""


def write_spz(
    path: Path, means: np.ndarray, quats: np.ndarray, log_scales: np.ndarray, logits: np.ndarray, sh: np.ndarray
) -> None:
    """Write N Gaussians: means [N, 3], quats wxyz [N, 4] of any length, log_scales [N, 3], logits [N], sh [N, K, 3].

    Axes are turned from OpenCV to OpenGL. Positions are exact to half a step of 2^-b scene units, b being as large as
    the farthest one allows; rotations to 0.2 degrees, logarithms of scales to 1/32 within -10..5.9, opacities to
    1/510, SH coefficients within -1..1 to 1/32 (degree 1) and 1/16.
    """
    degree = round(sh.shape[1] ** 0.5) - 1
    farthest = float(np.abs(means).max()) if len(means) else 0.0
    bits = int(np.clip(np.floor(np.log2((2**POSITION_BITS - 1) / max(farthest, 1e-9))), 0, MAX_FRACTION_BITS))
    parts = [
        struct.pack("<IIIBBBB", MAGIC, VERSION, len(means), degree, bits, 0, 0),
        _positions(means * FLIP, bits),
        _bytes(255 / (1 + np.exp(-logits.astype(float)))),
        _bytes(255 * (COLOUR_SCALE * sh[:, 0] + 0.5)),
        _bytes(LOG_SCALE_STEPS * (log_scales + LOG_SCALE_ZERO)),
        _rotations(quats),
        _harmonics(sh[:, 1:]),
    ]
    with atomic(path) as partial:
        partial.write_bytes(gzip.compress(b"".join(parts), mtime=0))


def _bytes(values: np.ndarray) -> bytes:
    return np.round(values).clip(0, 255).astype(np.uint8).tobytes()


def _positions(means: np.ndarray, bits: int) -> bytes:
    """Fixed-point numbers of 24 bits, the lowest byte first."""
    limit = 2**POSITION_BITS - 1
    fixed = np.round(means.astype(float) * 2**bits).clip(-limit, limit).astype("<i4")
    return np.ascontiguousarray(fixed).view(np.uint8).reshape(-1, 4)[:, :3].tobytes()


def _rotations(quats: np.ndarray) -> bytes:
    """The three smaller entries of the quaternions xyzw, 9 bits and a sign each, below 2 bits for the largest one."""
    turned = np.concatenate([quats[:, 1:] * FLIP, quats[:, :1]], axis=1).astype(float)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    largest = np.abs(turned).argmax(axis=1)
    turned *= np.where(np.take_along_axis(turned, largest[:, None], axis=1) < 0, -1, 1)
    steps = np.round(ROTATION_STEPS * np.abs(turned) * np.sqrt(2)).clip(0, ROTATION_STEPS).astype(np.uint32)
    entries = steps | ((turned < 0).astype(np.uint32) << np.uint32(9))
    packed = largest.astype(np.uint32)
    for k in range(4):
        packed = np.where(largest == k, packed, (packed << np.uint32(10)) | entries[:, k])
    return packed.astype("<u4").tobytes()


def _harmonics(rest: np.ndarray) -> bytes:
    """Coefficients [N, K - 1, 3] in steps of 1/128 around 128, rounded to whole buckets; colours vary fastest."""
    degrees = np.repeat([0, 1, 2], [3, 5, 7])[: rest.shape[1]]
    buckets = np.array(SH_BUCKETS)[degrees][:, None]
    steps = np.round(rest * SH_FLIP[: rest.shape[1], None] * SH_STEPS) + SH_STEPS
    return _bytes(np.floor((steps + buckets // 2) / buckets) * buckets)
