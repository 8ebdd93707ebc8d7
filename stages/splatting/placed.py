"""The Gaussians at a moment, as the rasteriser takes them, from their parameters: one node of autograd on the CPU."""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from stages.deformation import lbs_kernels, weight_kernels
from stages.shared.threads import spread
from stages.splatting import placed_kernels
from stages.splatting.life_spans import presence
from stages.splatting.raster_bins import MIN_ALPHA


class Placed(NamedTuple):
    """M Gaussians at a moment.

    Attributes:
        means: [M, 3] scene units. quats: [M, 4] wxyz. scales: [M, 3] scene units. opacities: [M] in 0..1.
        sh_dc: [M, 1, 3] constant SH coefficients.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh_dc: Tensor


class Canonical(NamedTuple):
    """What is not trained of N Gaussians, static ones first.

    Attributes:
        n_static: number of the static ones. fading: whether the others have life spans.
        anchors: [N, 3] scene units. footprints: [N]. births: [N] times. nearest: [D, K] control points of dynamic ones.
    """

    n_static: int
    fading: bool
    anchors: Tensor
    footprints: Tensor
    births: Tensor
    nearest: Tensor


class Motion(NamedTuple):
    """P control points at a moment.

    Attributes:
        points: [P, 3] canonical. quats: [P, 4] unit. translations: [P, 3] scene units.
        log_radii: [P] logarithms of the kernel radii. colours: [P, 3] offsets of the constant SH coefficient, or None.
    """

    points: Tensor
    quats: Tensor
    translations: Tensor
    log_radii: Tensor
    colours: Tensor | None


TRAINED = ("offsets", "log_scales", "quats", "logits", "log_spans", "drifts", "sh_dc")
"""Names of the parameters of Gaussians that `place` takes."""


def place(parameters: Any, fixed: Canonical, motion: Motion | None, time: float, rows: Tensor | None = None) -> Placed:
    """The Gaussians in `rows` at `time` 0..1, differentiable in their parameters and in `motion` but its points.

    The same as `GaussianScene.placed_torch`, on the CPU, with the rounding of another order of operations.

    Args:
        parameters: [N, ...] by name, as in TRAINED. motion: None if all Gaussians are static.
        rows: ascending indices of the Gaussians wanted, all static ones among them; None: all.
    """
    if motion is None:
        none = fixed.anchors[:0]
        fixed, motion = fixed._replace(n_static=len(fixed.anchors)), Motion(none, none, none, none, None)
    raw = [parameters[name] for name in TRAINED]
    return Placed(*_Place.apply(fixed, time, rows, *motion, *raw))  # type: ignore[no-untyped-call]


def drawn(births: Tensor, logits: Tensor, log_spans: Tensor, time: float) -> Tensor:
    """Ascending indices of those of D Gaussians, given by their parameters [D], that are opaque enough to be drawn."""
    if births.device.type != "cpu":
        return torch.nonzero(logits.sigmoid() * presence(births, log_spans, time) > MIN_ALPHA)[:, 0]
    there, least = np.empty(len(births), bool), np.float32(MIN_ALPHA)
    arrays = [_array(values) for values in (births, logits, log_spans)]
    spread(placed_kernels.drawn, len(there), np.float32(time), least, *arrays, there)
    return torch.from_numpy(np.flatnonzero(there))


class _Place(torch.autograd.Function):
    """The kernels of `placed_kernels` around those of skinning, which see the dynamic Gaussians alone."""

    @staticmethod
    def forward(ctx: Any, fixed: Canonical, time: float, rows: Tensor | None, *tensors: Tensor | None) -> Any:
        motion, raw = (list(map(_array, part)) for part in (tensors[:5], tensors[5:]))
        points, point_quats, translations, log_radii, colours = motion
        N, n_static = len(fixed.anchors), fixed.n_static
        chosen = np.arange(N) if rows is None else rows.numpy()
        M, K = len(chosen), fixed.nearest.shape[1]
        near, sq_dist = np.empty((M - n_static, K), np.int64), np.empty((M - n_static, K), np.float32)
        shapes = (M, 3), (M, 4), (M, 3), (M,), (M, 1, 3)
        means, quats, scales, opacities, constant = placed = [np.empty(shape, np.float32) for shape in shapes]
        life = chosen, n_static, np.float32(time), fixed.fading
        arrays = [_array(values) for values in (fixed.anchors, fixed.footprints, fixed.births, fixed.nearest)]
        spread(placed_kernels.place, M, *life, *arrays, *raw, points, *placed, near, sq_dist)
        ctx.skinned = None
        if n_static < M:
            radii = np.exp(-2 * log_radii)
            weights = weight_kernels.softmax_weights(sq_dist, radii, near)
            canonical = means[n_static:].copy(), quats[n_static:].copy()
            still = (*canonical, points, point_quats, translations, weights, near)
            means[n_static:], quats[n_static:] = lbs_kernels.blend(*still)
            if colours is not None:
                constant[n_static:, 0] += weight_kernels.blend_values(colours, weights, near)
            ctx.skinned = still, radii, sq_dist, colours is not None
        ctx.life, ctx.saved = life, (*arrays[1:3], raw[3], raw[4], scales, opacities)
        ctx.shapes = [values.shape for values in raw]
        return tuple(map(torch.from_numpy, placed))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        _, n_static, _, fading = ctx.life
        g_means, g_quats, g_scales, g_opacities, g_constant = map(_array, gradients)
        g_motion: list[np.ndarray | None] = [None] * 5
        if ctx.skinned is not None:
            still, radii, sq_dist, coloured = ctx.skinned
            *_, weights, near = still
            by_still = lbs_kernels.blend_adjoint(*(*still, g_means[n_static:], g_quats[n_static:]))
            g_means, g_quats = g_means.copy(), g_quats.copy()
            g_means[n_static:], g_quats[n_static:], _, g_motion[1], g_motion[2], g_weights = by_still
            _, g_radii = weight_kernels.softmax_weights_adjoint(sq_dist, radii, near, weights, g_weights, False)
            g_motion[3] = -2 * radii * g_radii
            if coloured:
                shade = g_constant[n_static:, 0]
                g_motion[4] = weight_kernels.blend_values_adjoint(shade, weights, near, len(radii))
        g_raw: list[np.ndarray | None] = [np.zeros(shape, np.float32) for shape in ctx.shapes]
        given = g_means, g_quats, g_scales, g_opacities, g_constant
        spread(placed_kernels.place_adjoint, len(g_means), *ctx.life, *ctx.saved, *given, *g_raw)
        if not fading:  # without life spans neither they nor drifts are trained
            g_raw[4] = g_raw[5] = None
        return (None, None, None, *(None if g is None else torch.from_numpy(g) for g in (*g_motion, *g_raw)))


def _array(tensor: Tensor | None) -> Any:
    return None if tensor is None else tensor.detach().contiguous().numpy()
