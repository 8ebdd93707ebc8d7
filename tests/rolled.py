"""Exact flow of a room seen through a rolling shutter by a camera that moves at all times, also between frames."""

from collections.abc import Callable

import numpy as np
from synthetic import OFFSETS, ROOM

from stages.ba.graph import FlowGraph, build_graph
from stages.shared import lie
from stages.shared.cameras import centred_intrinsics, pixel_grid

FOCAL, STRIDE = 0.9, 5
Path = Callable[[np.ndarray], np.ndarray]
"""Times in frames, of any shape, to poses [..., 4, 4]."""


def hand(
    turn: float, shift: float = 0.0, steady: tuple[float, ...] = (-0.05, 0.01, -0.03, 0.001, -0.004, 0.0007)
) -> Path:
    """A camera in the hand: steady twists per frame, and shakes of up to 3 Hz at 24 frames per second.

    Args:
        turn, shift: standard deviations of the shakes per axis, in radians and units of the room.
    """
    rng = np.random.default_rng(2)
    rate, phase = rng.uniform(0.2, 3.0, (5, 6)) / 24, rng.uniform(0, 2 * np.pi, (5, 6))
    weight = 1 / rate
    weight *= np.array([shift] * 3 + [turn] * 3) / np.sqrt((weight**2).sum(axis=0) / 2)

    def path(times: np.ndarray) -> np.ndarray:
        at = np.asarray(times, float)[..., None]
        return lie.exp_se3(at * steady + (weight * np.sin(2 * np.pi * rate * at[..., None] + phase)).sum(axis=-2))

    return path


def observe_rolled(
    path: Path, readout: float, T: int = 10, noise_px: float = 0.05, planes: tuple = ROOM, stride: int = STRIDE
) -> tuple[FlowGraph, np.ndarray]:
    """The graph of exact flow with noise between frames of 95 x 160 px, and the depth [T, h, w] of every pixel.

    Only the pixels at the centres of the cells of the graph have flow.
    """
    h, w, rng = 95, 160, np.random.default_rng(0)
    K, pixels = centred_intrinsics(FOCAL * w, w, h), pixel_grid(h, w)
    edges = [(i, j) for i in range(T) for j in range(T) if abs(i - j) in OFFSETS]
    seen = [_seen(path, k + readout * (np.arange(h) / (h - 1) - 0.5), pixels, K, planes) for k in range(T)]
    cells = slice(stride // 2, None, stride), slice(stride // 2, None, stride)
    flow, visible = np.zeros((len(edges), h, w, 2), np.float32), np.zeros((len(edges), h, w), np.float32)
    for e, (i, j) in enumerate(edges):
        target = pixels[cells]
        for _ in range(4):  # the row at which a point is seen decides when it is seen
            poses = path(j + readout * (target[..., 1] / (h - 1) - 0.5))
            points = np.einsum("hwab,hwb->hwa", poses[..., :3, :3], seen[i][1][cells]) + poses[..., :3, 3]
            target = points[..., :2] / points[..., 2:] * K[0, 0] + K[:2, 2]
        inside = (target >= 0).all(-1) & (target[..., 0] <= w - 1) & (target[..., 1] <= h - 1) & (points[..., 2] > 0)
        u, v = (np.clip(np.rint(target[..., c]), 0, (w, h)[c] - 1).astype(int) for c in (0, 1))
        flow[e][cells] = target - pixels[cells] + noise_px * rng.standard_normal(target.shape)
        visible[e][cells] = inside & (points[..., 2] < 1.05 * seen[j][0][v, u])
    source, target = np.array(edges).T
    return build_graph(source, target, flow, visible, T, stride), np.stack([depth for depth, _ in seen])


def _seen(
    path: Path, times: np.ndarray, pixels: np.ndarray, K: np.ndarray, planes: tuple
) -> tuple[np.ndarray, np.ndarray]:
    """Depth [h, w] and points [h, w, 3] that pixels see, each row at its own time [h]."""
    world_from_cam = lie.inverse(path(times))
    rays = np.concatenate([(pixels - K[:2, 2]) / K[0, 0], np.ones((*pixels.shape[:2], 1))], axis=2)
    rays, centres = np.einsum("hab,hwb->hwa", world_from_cam[:, :3, :3], rays), world_from_cam[:, :3, 3]
    depth = np.full(pixels.shape[:2], np.inf)
    for normal, distance in planes:
        with np.errstate(divide="ignore"):
            hit = (distance - centres @ normal)[:, None] / (rays @ normal)
        depth = np.where((hit > 0) & (hit < depth), hit, depth)
    return depth, centres[:, None] + depth[..., None] * rays
