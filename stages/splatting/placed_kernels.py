"""Numba kernels of the Gaussians at a moment: their raw parameters in canonical units, and the gradients of these.

One pass over the Gaussians that are there takes the place of some forty operations on whole tensors, of which none uses
more than a core to advantage. Skinning comes after it (see `placed`).
"""

import numpy as np
from numba import njit

from stages.shared.quaternion_kernels import FAST, ONE
from stages.splatting.life_spans import REACH

HALF, FARTHEST = np.float32(0.5), np.float32(REACH)
EXACT = FAST | {"fastmath": False}
"""Without fused multiply-add: means and drifts round as where they are written to a file, which then renders the same.
"""


@njit(inline="always", **EXACT)
def _age(births: np.ndarray, log_spans: np.ndarray, time: np.float32, n: int) -> np.float32:
    """Spans since the birth of Gaussian n."""
    return (time - births[n]) * np.exp(-log_spans[n])


@njit(inline="always", **EXACT)
def _opacity(logits: np.ndarray, n: int) -> np.float32:
    """Largest opacity of Gaussian n."""
    return ONE / (ONE + np.exp(-logits[n]))


@njit(**EXACT)
def drawn(first: int, last: int, time: np.float32, least: np.float32, births: np.ndarray, logits: np.ndarray,
          log_spans: np.ndarray, there: np.ndarray) -> None:  # fmt: skip
    """Fill `there` [D] bool: whether the opacity at `time` of Gaussians with these parameters [D] exceeds `least`."""
    for n in range(first, last):
        age = _age(births, log_spans, time, n)
        there[n] = _opacity(logits, n) * np.exp(-HALF * age * age) > least


@njit(**EXACT)
def place(first: int, last: int, rows: np.ndarray, n_static: int, time: np.float32, fading: bool, anchors: np.ndarray,
          footprints: np.ndarray, births: np.ndarray, index: np.ndarray, offsets: np.ndarray, log_scales: np.ndarray,
          quats: np.ndarray, logits: np.ndarray, log_spans: np.ndarray, drifts: np.ndarray, sh_dc: np.ndarray,
          points: np.ndarray, means: np.ndarray, turned: np.ndarray, scales: np.ndarray, opacities: np.ndarray,
          constant: np.ndarray, near: np.ndarray, sq_dist: np.ndarray) -> None:  # fmt: skip
    """Fill means [M, 3], turned [M, 4], scales [M, 3], opacities [M] and constant [M, 1, 3] of the Gaussians in `rows`
    [M]; of the dynamic ones, which come after the static, `near` [D, K] and `sq_dist` [D, K]: control points and
    squared distances from them. `time`, `fading` and the parameters as in `placed.place`."""
    for m in range(first, last):
        n = rows[m]
        opacities[m] = _opacity(logits, n)
        for a in range(3):
            means[m, a] = anchors[n, a] + footprints[n] * offsets[n, a]
            scales[m, a] = np.exp(log_scales[n, a])
            constant[m, 0, a] = sh_dc[n, 0, a]
        for a in range(4):
            turned[m, a] = quats[n, a]
        if n < n_static:
            continue
        for k in range(index.shape[1]):
            p = index[n - n_static, k]
            x, y, z = means[m, 0] - points[p, 0], means[m, 1] - points[p, 1], means[m, 2] - points[p, 2]
            near[m - n_static, k], sq_dist[m - n_static, k] = p, x * x + y * y + z * z
        if fading:
            age = _age(births, log_spans, time, n)
            opacities[m] *= np.exp(-HALF * age * age)
            age = min(max(age, -FARTHEST), FARTHEST)
            for a in range(3):
                means[m, a] += age * (footprints[n] * drifts[n, a])


@njit(**EXACT)
def place_adjoint(first: int, last: int, rows: np.ndarray, n_static: int, time: np.float32, fading: bool,
                  footprints: np.ndarray, births: np.ndarray, logits: np.ndarray, log_spans: np.ndarray,
                  scales: np.ndarray, opacities: np.ndarray, g_means: np.ndarray, g_turned: np.ndarray,
                  g_scales: np.ndarray, g_opacities: np.ndarray, g_constant: np.ndarray, g_offsets: np.ndarray,
                  g_log_scales: np.ndarray, g_quats: np.ndarray, g_logits: np.ndarray, g_log_spans: np.ndarray,
                  g_drifts: np.ndarray, g_sh_dc: np.ndarray) -> None:  # fmt: skip
    """Fill the rows of the parameters' gradients from those of what `place` filled: no gradient by the distances."""
    for m in range(first, last):
        n = rows[m]
        for a in range(3):
            g_offsets[n, a] = footprints[n] * g_means[m, a]
            g_log_scales[n, a] = scales[m, a] * g_scales[m, a]
            g_sh_dc[n, 0, a] = g_constant[m, 0, a]
        for a in range(4):
            g_quats[n, a] = g_turned[m, a]
        g = opacities[m] * g_opacities[m]
        g_logits[n] = g / (ONE + np.exp(logits[n]))
        if fading and n >= n_static:
            age = _age(births, log_spans, time, n)
            g_log_spans[n] = age * age * g
            way = footprints[n] * min(max(age, -FARTHEST), FARTHEST)
            for a in range(3):
                g_drifts[n, a] = way * g_means[m, a]
