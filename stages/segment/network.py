"""A small network that decides near the borders of masks, by all that is known of a pixel and of those around it.

Each evidence misleads somewhere: the flow leaks at borders, a shadow stands out from the background like a rope does,
colours repeat. Which to believe where is learnt, on drawn scenes (`training.masks`). Convolutions with growing holes
(Yu and Koltun, ICLR 2016) correct what the evidence says together; each adds to what it is given.
"""

from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np
from scipy.special import expit

from stages.shared.artifacts import read_model
from stages.shared.images import enlarge
from stages.shared.window_kernels import KERNEL

WEIGHTS = Path(__file__).with_name("network.safetensors")
STEPS = 1, 2, 4, 8
"""Pixels between the taps of each convolution."""
REACH = sum(STEPS)
"""Pixels around one that count."""
BELIEVED = 2.0
"""Logit of what the evidence says is certain: what the network corrects."""
COUNTED = 0.5
"""Share of its correction that counts: of families of scenes that it has not learnt from it is too sure."""


class Network(NamedTuple):
    """Weights, float32.

    Attributes:
        first: [c, n], first_bias: [c], of n maps. kernels: [len(STEPS), c, c, 3, 3], biases: [len(STEPS), c].
        last: [c], last_bias: [1].
    """

    first: np.ndarray
    first_bias: np.ndarray
    kernels: np.ndarray
    biases: np.ndarray
    last: np.ndarray
    last_bias: np.ndarray


def read_network() -> Network:
    """The network that is shipped."""
    return Network(**read_model(WEIGHTS))


def correct(network: Network, maps: np.ndarray, asked: np.ndarray, sureness: np.ndarray) -> np.ndarray:
    """How surely [H, W] float32, 0..1, pixels move: by the network where they are asked, else as before.

    Args:
        maps: [n, h, w] float32, what is known of the pixels, of the frame or of it reduced.
        asked: [H, W] bool. sureness: [H, W] in 0..1, without it.
    """
    if not asked.any():
        return sureness
    (H, W), size, part = asked.shape, maps.shape[1:], []
    for axis, small, full in zip((1, 0), size, (H, W), strict=True):
        first, last = np.flatnonzero(asked.any(axis=axis))[[0, -1]] * small // full
        part.append(slice(max(first - REACH, 0), last + REACH + 1))
    correction = np.zeros(size, np.float32)
    correction[tuple(part)] = _correction(network, maps[:, *part])
    logit = BELIEVED * (2 * sureness - 1) + COUNTED * enlarge(correction, (W, H))
    return np.where(asked, expit(logit), sureness).astype(np.float32)


def _correction(network: Network, maps: np.ndarray) -> np.ndarray:
    """What the network adds to the logit [H, W] of each pixel."""
    (_, H, W), pad = maps.shape, max(STEPS)
    inner = np.s_[:, pad : pad + H, pad : pad + W]
    given = np.zeros((len(network.first), H + 2 * pad, W + 2 * pad), np.float32)
    given[inner] = np.maximum(np.tensordot(network.first, maps, 1) + network.first_bias[:, None, None], 0)
    result, row = np.zeros_like(given), np.empty(W, np.float32)
    for step, kernel, bias in zip(STEPS, network.kernels, network.biases, strict=True):
        _convolve(given.reshape(-1), given.shape, kernel, bias, step, pad, row, result)
        given, result = result, given
    return np.asarray(np.tensordot(network.last, given[inner], 1) + network.last_bias)


@numba.njit(**KERNEL | {"fastmath": {"reassoc", "nsz", "contract"}})
def _convolve(given, size, kernel, bias, step, pad, row, result):  # type: ignore[no-untyped-def]
    """Into the result [c, h, w]: maps of this size, `given` as one row, and what a convolution with ReLU finds in them.

    Within `pad` pixels of the border nothing is written, and `row` is room for a row of the rest. The nine taps between
    two maps are summed at once, by unsigned indices, so that the loop over a row becomes vector instructions.
    """
    c, h, w = size
    for y in range(pad, h - pad):
        for to in range(c):
            for x in range(len(row)):
                row[x] = bias[to]
            for of in range(c):
                middle = (of * h + y) * w + pad
                above, below = middle - step * w, middle + step * w
                k00, k01, k02 = kernel[to, of, 0, 0], kernel[to, of, 0, 1], kernel[to, of, 0, 2]
                k10, k11, k12 = kernel[to, of, 1, 0], kernel[to, of, 1, 1], kernel[to, of, 1, 2]
                k20, k21, k22 = kernel[to, of, 2, 0], kernel[to, of, 2, 1], kernel[to, of, 2, 2]
                for x in range(len(row)):
                    a, b, d = np.uint64(above + x), np.uint64(middle + x), np.uint64(below + x)
                    s = np.uint64(step)
                    total = k00 * given[a - s] + k01 * given[a] + k02 * given[a + s]
                    total += k10 * given[b - s] + k11 * given[b] + k12 * given[b + s]
                    row[np.uint64(x)] += total + k20 * given[d - s] + k21 * given[d] + k22 * given[d + s]
            for x in range(len(row)):
                result[to, y, pad + x] = given[(to * h + y) * w + pad + x] + max(row[x], np.float32(0))
