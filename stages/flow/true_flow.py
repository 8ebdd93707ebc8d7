"""True flow between any two frames, from true depth, cameras and forward flow: the result of perfect matching."""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from stages.flow.edges import Edge
from stages.given.flow import on_grid
from stages.shared import sequences, sintel
from stages.shared.cameras import pixel_grid, projection, scale_intrinsics, static_flow
from stages.shared.errors import InputError
from stages.shared.finite import is_finite
from stages.shared.images import read_mask, reduce
from stages.shared.warp import is_inside, matches, warp

NEEDED = ("camdata_left", "depth", "flow")
MOVING_PX = 0.1
"""Without motion masks, a pixel is moving if its true flow differs by more than this from that of a static scene."""
DEPTH_AGREEMENT = 0.02
"""Relative difference of depth up to which two pixels show the same surface."""
SMOOTH_PX = 1.0
"""Flow that varies more than this over 3 x 3 px is not interpolated: it crosses the boundary of a surface."""
INVERSION_STEPS, INVERSION_PX = 8, 0.05
"""Fixed-point iterations of the inversion, and the largest residual that is accepted."""

Step = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Truth:
    """Truth of T frames on the flow grid [h, w].

    Attributes:
        cam_from_world: [T, 4, 4]; Ks: [T, 3, 3] in grid pixels.
        inverse_depth: [T, h, w] float32, zero where the grid mixes two surfaces.
        moving: [T, h, w] bool, pixels that move in the world.
        steps: flow [h, w, 2] px of moving pixels between neighbouring frames, both ways, and where it is known.
    """

    cam_from_world: np.ndarray
    Ks: np.ndarray
    inverse_depth: np.ndarray
    moving: np.ndarray
    steps: Mapping[Edge, Step]


def read_truth(frames: sequences.Sequence, width: int, height: int) -> Truth:
    """Truth of a sequence, reduced to width x height px.

    Raises:
        InputError: if truth is missing, with its kinds, or if the true flow is not finite.
    """
    missing = [kind for kind in NEEDED if not frames.has_truth(kind)]
    if missing:
        expected = f"{', '.join(NEEDED)} of every frame for `source: truth`"
        raise InputError(frames.frames[0].parent, expected, f"no {', '.join(missing)}", "set `source: dis`")
    if frames.truth.get("distortion"):
        found = "the truth of a distorted lens beside them"
        raise InputError(frames.frames[0].parent, "frames of a pinhole for `source: truth`", found, "set `source: dis`")
    full_Ks, poses = sintel.read_cams(frames.truth_files("camdata_left"))
    Ks = scale_intrinsics(full_Ks, width / frames.width)
    size = (width, height)
    depth = np.stack([_reduce(1 / sintel.read_dpt(path), size) for path in frames.truth_files("depth")])
    forward = np.stack([_read_forward(frames, n, size) for n in frames.numbers[:-1]])
    known = np.stack([_is_unoccluded(frames, n, size) for n in frames.numbers[:-1]])
    still = Truth(poses, Ks, depth, np.zeros(depth.shape, bool), {})
    moving = _read_moving(frames, size) if frames.has_truth("motion_mask") else _derived_moving(still, forward)
    steps: dict[Edge, Step] = {}
    for k, (flow, seen) in enumerate(zip(forward, known, strict=True)):
        steps[k, k + 1] = flow, seen & moving[k]
        steps[k + 1, k] = inverted(*steps[k, k + 1], depth[k], moving[k + 1])
    return Truth(poses, Ks, depth, moving, steps)


class TrueFlow:
    """True flow between frames; its confidence is 1 where it is known, else 0 (a `passes.Matcher`)."""

    others: frozenset[Edge] = frozenset()

    def __init__(self, truth: Truth) -> None:
        self.truth, self.seen = truth, dict[Edge, np.ndarray]()

    def near(self, edges: list[Edge], near: Mapping[Edge, np.ndarray]) -> tuple[dict[Edge, np.ndarray], int]:
        """True flow [h, w, 2] px of every edge."""
        return self.far(edges, near, near), 0

    def far(
        self, edges: list[Edge], _near: Mapping[Edge, np.ndarray], _far: Mapping[Edge, np.ndarray]
    ) -> dict[Edge, np.ndarray]:
        """True flow [h, w, 2] px of every edge."""
        found = {edge: true_flow(self.truth, edge) for edge in edges}
        self.seen = {edge: known for edge, (_, known) in found.items()}
        return {edge: flow for edge, (flow, _) in found.items()}

    def confidence(self, edge: Edge, _flow: Mapping[Edge, np.ndarray]) -> np.ndarray:
        """Where the flow of an edge found last is known, [h, w] bool."""
        return self.seen[edge]


def true_flow(truth: Truth, edge: Edge) -> Step:
    """Flow [h, w, 2] float32 px of an edge, and where it is known: the point is visible in both frames, [h, w] bool.

    The flow of static pixels follows from depth and cameras; it is known where the depths of both frames agree. The
    flow of moving pixels is chained from the true flow of single steps, inverted for steps backwards; it is known where
    every step is.
    """
    i, j = edge
    flow, known = _static_motion(truth, i, j)
    if truth.moving[i].any():
        moved, seen = _followed(truth.steps, i, j)
        flow = np.where(truth.moving[i][..., None], moved, flow)
        known = np.where(truth.moving[i], seen, known)
    return flow, np.asarray(known)


def inverted(flow: np.ndarray, known: np.ndarray, inverse_depth: np.ndarray, there: np.ndarray) -> Step:
    """Flow [h, w, 2] px from the target of `flow` back to its source, and where it is known, [h, w] bool.

    It solves back(x) = -flow(x + back(x)) by fixed-point iteration. The initial value is the flow that lands nearest to
    x; of several surfaces that land there, the nearest to the camera is visible.

    Args:
        known: [h, w] bool, where `flow` is known. inverse_depth: [h, w] of the source.
        there: [h, w] bool, pixels of the target to which the result is restricted.
    """
    h, w = known.shape
    back = np.zeros_like(flow)
    u, v = (np.rint(place).astype(int) for place in matches(flow))
    landed = known & (u >= 0) & (u < w) & (v >= 0) & (v < h)
    order = np.argsort(inverse_depth[landed], kind="stable")
    hit = np.zeros((h, w), np.float32)
    back[v[landed][order], u[landed][order]] = -flow[landed][order]
    hit[v[landed], u[landed]] = 1
    near = cv2.blur(hit, (3, 3))
    holes = (hit == 0) & (near > 0)
    back[holes] = cv2.blur(back, (3, 3))[holes] / near[holes][:, None]
    for _ in range(INVERSION_STEPS):
        back = -warp(flow, back)
    solved = np.linalg.norm(back + warp(flow, back), axis=-1) < INVERSION_PX
    usable = warp((known & _is_smooth(flow)).astype(np.float32), back) == 1
    return back, solved & usable & is_inside(back) & there & (near > 0)


def _followed(steps: Mapping[Edge, Step], i: int, j: int) -> Step:
    """Flow of moving pixels from frame i to j, chained from single steps, and where it is known."""
    sign = 1 if j > i else -1
    total, known = steps[i, i + sign]
    for k in range(i + sign, j, sign):
        flow, seen = steps[k, k + sign]
        usable = (seen & _is_smooth(flow)).astype(np.float32)
        known = known & is_inside(total) & (warp(usable, total) == 1)
        total = total + warp(flow, total)
    return total, known & is_inside(total)


def _static_motion(truth: Truth, i: int, j: int) -> Step:
    """Flow of static pixels from frame i to j, and where the point is visible in frame j."""
    inverse_depth = truth.inverse_depth[i]
    pixels, cameras = pixel_grid(*inverse_depth.shape), projection(_camera(truth, i), _camera(truth, j))
    static, ratio = static_flow(pixels, inverse_depth.astype(float), *cameras)
    in_front = (inverse_depth > 0) & (ratio > 0)
    flow = np.where(in_front[..., None], static, 0).astype(np.float32)
    depth = ratio / np.where(in_front, inverse_depth, 1)
    same = np.abs(warp(truth.inverse_depth[j], flow) * depth - 1) < DEPTH_AGREEMENT
    covered = warp(truth.moving[j].astype(np.float32), flow) > 0
    return flow, in_front & is_inside(flow) & same & ~covered & ~truth.moving[i]


def _camera(truth: Truth, k: int) -> tuple[np.ndarray, np.ndarray]:
    return truth.cam_from_world[k], truth.Ks[k]


def _is_smooth(flow: np.ndarray) -> np.ndarray:
    """Where flow [h, w, 2] varies little over 3 x 3 px."""
    kernel = np.ones((3, 3), np.uint8)
    return np.asarray((cv2.dilate(flow, kernel) - cv2.erode(flow, kernel)).max(axis=-1) < SMOOTH_PX)


def _reduce(inverse_depth: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Inverse depth on the grid: interpolated linearly within a surface, zero across the boundary of two."""
    nearest = reduce(inverse_depth, size, cv2.INTER_NEAREST_EXACT)
    linear = reduce(inverse_depth, size, cv2.INTER_LINEAR)
    one_surface = np.abs(linear - nearest) < DEPTH_AGREEMENT * nearest
    return np.asarray(np.where(one_surface, linear, 0), np.float32)


def _read_forward(frames: sequences.Sequence, number: int, size: tuple[int, int]) -> np.ndarray:
    flow = sintel.read_flo(path := frames.truth["flow"][number])
    if not is_finite(flow):
        raise InputError(path, "finite flow for `source: truth`", "NaN or infinity", "set `source: dis`")
    return on_grid(flow, np.ones(flow.shape[:2], bool), size)[0]


def _is_unoccluded(frames: sequences.Sequence, number: int, size: tuple[int, int]) -> np.ndarray:
    """Where the true flow of a frame is valid and its target is not occluded, [h, w] bool."""
    hidden = np.zeros((frames.height, frames.width), bool)
    for kind in ("occlusions", "invalid"):
        if path := frames.truth.get(kind, {}).get(number):
            hidden |= read_mask(path)
    return np.asarray(reduce(hidden.astype(np.float32), size) == 0)


def _read_moving(frames: sequences.Sequence, size: tuple[int, int]) -> np.ndarray:
    masks = [read_mask(path).astype(np.uint8) for path in frames.truth_files("motion_mask")]
    return np.stack([reduce(mask, size, cv2.INTER_NEAREST_EXACT) > 0 for mask in masks])


def _derived_moving(still: Truth, forward: np.ndarray) -> np.ndarray:
    """Pixels [T, h, w] whose true flow is not that of a static scene; in the last frame, where such flow ends."""
    moving = np.zeros(still.inverse_depth.shape, bool)
    for k, flow in enumerate(forward):
        moving[k] = np.linalg.norm(flow - _static_motion(still, k, k + 1)[0], axis=-1) > MOVING_PX
    u, v = (np.rint(place[moving[-2]]).astype(int) for place in matches(forward[-1]))
    h, w = forward[-1].shape[:2]
    inside = (u >= 0) & (u < w) & (v >= 0) & (v < h)
    landed = np.zeros((h, w), np.uint8)
    landed[v[inside], u[inside]] = 1
    moving[-1] = cv2.dilate(landed, np.ones((3, 3), np.uint8)) > 0
    return moving
