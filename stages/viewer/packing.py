"""The 4D model as one compact blob for the viewer: arrays behind one another, and a header that says where each lies.

All lengths are in units of the median distance of the Gaussians from the origin, so that float16 suits scenes of any
unit. With N Gaussians, D of them dynamic, K control points each, P control points, T frames and R moments, evenly
spread over them, at which motions are packed, the last B static ones under moving shadows, and as many moments Q of
these as room is left for, the arrays are:

| array | type | content | precision |
|---|---|---|---|
| means | float32 [N, 3] | canonical, static ones first | float16 would err by up to a quarter of a pixel |
| quats | float16 [N, 4] | unit, wxyz | 0.5 milliradian |
| shapes | float16 [N, 4] | logarithms of the scales, opacity | 0.4 %, 0.0005 |
| sh_dc | float16 [N, 3] | constant coefficients | 0.0005 |
| sh_rest | int8 [N, C, 3] | the other C = (degree + 1)^2 - 1, in 1/127 of `sh_steps` [C, 3] | half a step |
| index, weights | uint16, uint8 [D, K] | skinning pairs, heaviest first; a row of weights sums to 255 | 1/510 |
| lives | float32 [D, 2] | frame of largest opacity; 1 / (span sqrt(2)), in 1 / frames: 0 if always there | - |
| drifts | float16 [D, 3] | motion of the mean in span sqrt(2), from its birth on | 1/2048 |
| instances | uint8 [D] | number of the instance, 0: none | - |
| points | float32 [P, 3] | canonical control points | - |
| motions | float16 [R, P, 10] | quaternion, translation, colour offset of each point and moment | 1/2048 |
| shadows | int8 [Q, B] | how much of `shadow_colours` is added, in 1/127 of `shadow_step` | half a step then |
| shadow_colours | int8 [B, 3] | direction of that in the constant coefficients, in 1/127 | half a step |
| gains | float32 [T, 3] | exposure | - |
| poses, lenses | float32 [T, 12], [T, 4] | rows of cam_from_world [3, 4]; fx fy cx cy in px of the frame | - |
"""

import base64
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from stages.deformation.splines import at_times, spline_basis
from stages.shared.cameras import Cameras
from stages.splatting.cloud import select
from stages.splatting.gaussian_model import GaussianScene
from stages.splatting.life_spans import ALWAYS
from stages.splatting.projection_kernels import BLUR

SH_LEVELS = 127
WEIGHT_SUM = 255
MOTION_BYTES, MOTION_POINT_BYTES = 2_400_000, 20
"""Motions take at most so much, before base64; and what a control point takes at a moment."""
SHADOW_BYTES = 800_000
"""The same of moving shadows, of which a Gaussian takes one byte at a moment."""
ALIGNMENT = 4
"""Arrays begin at multiples of this many bytes, which typed arrays of the browser demand."""


@torch.no_grad()
def pack_scene(
    scene: GaussianScene, cameras: Cameras, times: np.ndarray, instances: np.ndarray
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays of the table above, and the numbers that the shaders need besides.

    Args:
        cameras: of the T frames at `times` [T] in 0..1; the pose corrections of the scene are applied to them.
        instances: [D] number of the instance of each dynamic Gaussian, 0 if none; at most 255.
    """
    order, shadows, shadow_colours, shadow_step = packed_shadows(scene, times)
    cloud, n = select(scene.cloud(), torch.as_tensor(order)), scene.n_static
    means = cloud.means.double().cpu().numpy()
    unit = length_unit(means)
    sh = cloud.sh.cpu().numpy()
    sh_rest, sh_steps = quantised_sh(sh[:, 1:])
    log_scales, opacities = cloud.log_scales.cpu().numpy() - np.log(unit), cloud.logits.sigmoid().cpu().numpy()
    index, weights = quantised_pairs(*_pairs(scene))
    points, motions = packed_motions(scene, moments_of_motion(scene, times), unit)
    poses, lenses = _packed_cameras(scene, cameras, times, unit)
    arrays: dict[str, np.ndarray] = {
        "means": (means / unit).astype(np.float32),
        "quats": torch.nn.functional.normalize(cloud.quats, dim=-1).cpu().numpy().astype(np.float16),
        "shapes": np.column_stack([log_scales, opacities]).astype(np.float16),
        "sh_dc": sh[:, 0].astype(np.float16),
        "sh_rest": sh_rest,
        "index": index,
        "weights": weights,
        "lives": _lives(scene, len(times)),
        "drifts": (np.sqrt(2) / unit * cloud.drifts[n:].cpu().numpy()).astype(np.float16),
        "instances": instances.astype(np.uint8),
        "points": points,
        "motions": motions,
        "shadows": shadows,
        "shadow_colours": shadow_colours,
        "gains": _gains(scene, times),
        "poses": poses,
        "lenses": lenses,
    }
    numbers = {
        "sh_degree": scene.sh_degree,
        "sh_steps": sh_steps.ravel().tolist(),
        "background": scene.background.cpu().tolist(),
        "near": scene.near_plane / unit,
        "blur": BLUR,
        **_fog(scene, unit),
        "static": n,
        "shadow_step": shadow_step,
        "frames": cameras.numbers.tolist(),
    }
    return arrays, numbers


def to_blob(arrays: Mapping[str, np.ndarray]) -> tuple[str, dict[str, dict[str, Any]]]:
    """All arrays as one base64 text, little-endian, and by name the type, shape and first byte of each."""
    parts, layout, at = [], {}, 0
    for name, array in arrays.items():
        content = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<")).tobytes()
        layout[name] = {"type": array.dtype.name, "shape": list(array.shape), "at": at}
        parts.append(content + bytes(-len(content) % ALIGNMENT))
        at += len(parts[-1])
    return base64.b64encode(b"".join(parts)).decode(), layout


def length_unit(means: np.ndarray) -> float:
    """The median distance of means [N, 3] from the origin, 1 where it is zero or there is none."""
    median = float(np.median(np.linalg.norm(means, axis=-1))) if len(means) else 0.0
    return median if median > 0 else 1.0


def quantised_sh(rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients [N, C, 3] as int8 in -127..127, and what 127 stands for, [C, 3]."""
    steps = np.abs(rest).max(axis=0, initial=0.0)
    shares = np.divide(rest, steps, out=np.zeros_like(rest), where=steps > 0)
    return np.round(SH_LEVELS * shares).astype(np.int8), steps


def quantised_pairs(index: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index [D, K] as uint16 and weights [D, K], whose rows sum to 1, as uint8 whose rows sum to 255; heaviest first.

    What rounding down leaves over goes to the largest remainders, so no Gaussian is drawn towards the origin.
    """
    order = np.argsort(-weights, axis=1, kind="stable")
    index, weights = (np.take_along_axis(values, order, axis=1) for values in (index, weights))
    scaled = WEIGHT_SUM * weights.astype(float)
    whole = np.floor(scaled)
    missing = WEIGHT_SUM - whole.sum(axis=1, keepdims=True)
    rank = np.argsort(np.argsort(whole - scaled, axis=1, kind="stable"), axis=1)
    return index.astype(np.uint16), (whole + (rank < missing)).astype(np.uint8)


def _moments(times: np.ndarray, each: int, most: int) -> np.ndarray:
    """The times [R] at which values over time are packed that take so many bytes `each`: those of the frames [T], or
    fewer where these take more than `most`."""
    count = max(2, most // max(each, 1))
    return times if len(times) <= count else np.linspace(times[0], times[-1], count)


def moments_of_motion(scene: GaussianScene, times: np.ndarray) -> np.ndarray:
    """The times [R] at which motions are packed."""
    points = 0 if scene.deformation is None else len(scene.deformation.points)
    return _moments(times, MOTION_POINT_BYTES * points, MOTION_BYTES)


@torch.no_grad()
def packed_shadows(scene: GaussianScene, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """What moving shadows add to the constant coefficients of the Gaussians under them, which change along one line.

    Returns:
        The order [N] of the Gaussians, in which these come last of all static ones; amounts [Q, B] int8; directions
        [B, 3] int8, unit vectors times 127; and the amount that 127 stands for.
    """
    n, under = scene.n_static, np.zeros(len(scene.anchors), bool)
    if scene.shadows is None:
        return np.arange(len(under)), np.zeros((len(times), 0), np.int8), np.zeros((0, 3), np.int8), 0.0
    table, means = scene.shadows, scene.means[:n]
    near = table.weights(means).sum(dim=1) > 0
    under[table.rows[near].cpu().numpy()] = True
    order = np.concatenate([np.argsort(under[:n], kind="stable"), np.arange(n, len(under))])
    moments = _moments(times, int(under.sum()), SHADOW_BYTES)
    added = torch.stack([table.of_static(means, float(time))[near] for time in moments]).double().cpu().numpy()
    directions = np.linalg.eigh(np.einsum("qbi,qbj->bij", added, added))[1][..., -1]
    amounts = np.einsum("qbc,bc->qb", added, directions)
    step = float(np.abs(amounts).max(initial=0.0))
    amounts, directions = (np.round(SH_LEVELS * of).astype(np.int8) for of in (amounts / (step or 1.0), directions))
    return order, amounts, directions, step


def packed_motions(scene: GaussianScene, times: np.ndarray, unit: float) -> tuple[np.ndarray, np.ndarray]:
    """Control points [P, 3] float32 and their motions [R, P, 10] float16: unit quaternion, translation, colour offset.

    Quaternions of successive moments have the same sign, so the viewer can interpolate them.
    """
    if scene.deformation is None:
        return np.zeros((0, 3), np.float32), np.zeros((len(times), 0, 10), np.float16)
    quats, translations = (values.cpu().numpy() for values in scene.deformation(torch.as_tensor(times).float()))
    along = np.einsum("tpi,tpi->tp", quats[1:], quats[:-1])
    signs = np.cumprod(np.concatenate([np.ones_like(along[:1]), np.where(along < 0, -1.0, 1.0)]), axis=0)
    colours = np.zeros_like(translations)
    if scene.colours is not None:
        basis = spline_basis(scene.colours.knots, times)
        colours = at_times(basis.to(scene.colours.table.device), scene.colours.table).cpu().numpy()
    motions = np.concatenate([quats * signs[..., None], translations / unit, colours], axis=-1)
    return (scene.deformation.points.cpu().numpy() / unit).astype(np.float32), motions.astype(np.float16)


def _pairs(scene: GaussianScene) -> tuple[np.ndarray, np.ndarray]:
    """Index and weights [D, K] of the dynamic Gaussians; K = 1 and no row if there are none."""
    if scene.deformation is None:
        return np.zeros((0, 1), np.int64), np.zeros((0, 1), np.float32)
    weights = scene.skinning_weights(scene.means[scene.n_static :], scene.index)
    return scene.index.cpu().numpy(), weights.cpu().numpy()


def _lives(scene: GaussianScene, T: int) -> np.ndarray:
    """Life spans [D, 2] of the dynamic Gaussians in frames, which the T frames of the clip are evenly spread over."""
    births, log_spans = (x[scene.n_static :].double().cpu().numpy() for x in (scene.births, scene.cloud().log_spans))
    rates = np.exp(-log_spans) / (np.sqrt(2) * (T - 1)) * (log_spans < ALWAYS)
    return np.column_stack([births * (T - 1), rates]).astype(np.float32)


def _gains(scene: GaussianScene, times: np.ndarray) -> np.ndarray:
    """Exposure gains [T, 3], 1 where none are modelled."""
    if scene.exposure is None:
        return np.ones((len(times), 3), np.float32)
    return torch.stack([scene.exposure(float(time)) for time in times]).cpu().numpy().astype(np.float32)


def _fog(scene: GaussianScene, unit: float) -> dict[str, Any]:
    """Extinction per unit of the packed model, 0 in clear air, and linear airlight [3]."""
    if scene.atmosphere is None:
        return {"extinction": 0.0, "airlight": [0.0, 0.0, 0.0]}
    air = scene.atmosphere
    return {"extinction": float(air.extinction) * unit, "airlight": air.airlight.cpu().tolist()}


def _packed_cameras(
    scene: GaussianScene, cameras: Cameras, times: np.ndarray, unit: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the corrected cam_from_world [T, 12], and fx fy cx cy [T, 4]."""
    poses = cameras.cam_from_world.copy()
    if scene.poses is not None:
        corrections = [scene.poses(float(time)).cpu().numpy() for time in times]
        poses = np.stack(corrections) @ poses
    poses[:, :3, 3] /= unit
    lenses = cameras.Ks[:, [0, 1, 0, 1], [0, 1, 2, 2]]
    return poses[:, :3].reshape(-1, 12).astype(np.float32), lenses.astype(np.float32)
