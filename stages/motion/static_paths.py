"""Where the static scene takes the pixels of tracks: cameras, the depths around them, and what the cameras miss."""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from stages.motion.photometric import static_depths
from stages.motion.shadows import log_detail, patches
from stages.motion.tracks import REACH
from stages.shared.cameras import projection
from stages.shared.flow_pairs import FlowPairs

COARSE = 8
"""Every eighth pixel, each way, is enough for what most flow has in common."""
COMMON_PX = 0.4, 0.1
"""Robust scale of the common residual, at first and at last, each for some iterations."""
ITERATIONS = 4
RIDGE = 1e-3
Z_MIN = 0.05
TINY = 1e-12


class Surroundings(NamedTuple):
    """A frame's static inverse depths [h, w] (farthest and nearest around, and its own), and its detail [h, w].

    `common`: coefficients [3, 2], for `affine`, of the residual px that most of its flow to the next frame has.
    """

    far: np.ndarray
    near: np.ndarray
    own: np.ndarray
    detail: np.ndarray
    common: np.ndarray


class Projected:
    """Pixels uv [k, 2] seen in other frames, by projections A [(k), 3, 3] and b [(k), 3], at any inverse depth."""

    def __init__(self, A: np.ndarray, b: np.ndarray, uv: np.ndarray) -> None:
        self.far = (A[..., :2] @ uv[..., None])[..., 0] + A[..., 2]
        self.b = np.broadcast_to(b, self.far.shape)

    def at(self, inverse_depth: np.ndarray) -> np.ndarray:
        """Pixels [k, 2] at inverse depths [k]."""
        seen = self.far + inverse_depth[:, None] * self.b
        return np.asarray(seen[:, :2] / np.maximum(seen[:, 2:], Z_MIN))

    def nearest(self, uv: np.ndarray) -> np.ndarray:
        """Inverse depths [k] at which they come nearest to pixels uv [k, 2], by linear least squares."""
        slope, offset = self.b[:, :2] - uv * self.b[:, 2:], uv * self.far[:, 2:] - self.far[:, :2]
        return np.asarray((slope * offset).sum(axis=1) / ((slope**2).sum(axis=1) + TINY))


class StaticScene:
    """The static scene of a clip; what frames near each other need is kept.

    Attributes:
        pairs: its flow. around: the `Surroundings` of a frame.
    """

    def __init__(
        self,
        pairs: FlowPairs,
        rgb: np.ndarray,
        cameras: tuple[np.ndarray, np.ndarray],
        inverse_depth: np.ndarray,
        residual: np.ndarray,
    ) -> None:
        """Take flow, frames [T, h, w, 3], cam_from_world [T, 4, 4] with Ks [T, 3, 3] on the grid, and the depth search.

        Args:
            inverse_depth, residual: [T, h, w] of `resweep.camera_evidence`.
        """
        self.pairs, self._cameras = pairs, cameras
        of_frame = partial(_around, pairs, rgb, cameras, inverse_depth, residual)  # a method would keep its own cache
        self.around: Callable[[int], Surroundings] = lru_cache(2 * REACH + 2)(of_frame)

    def projections(self, i: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A [k, 3, 3] and b [k, 3] from frames i [k] to frames j [k]."""
        edges, which = np.unique(np.stack([i, j]), axis=1, return_inverse=True)
        poses, Ks = self._cameras
        A, b = projection(*((poses[k], Ks[k]) for k in edges))
        return A[which], b[which]

    def depths(self, frames: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Farthest, nearest and own inverse depth [k] around pixels uv [k, 2] of frames [k]."""
        found = np.zeros((3, len(uv)))
        u, v = np.rint(uv).astype(int).T
        for k, rows in by_frame(frames):
            found[:, rows] = [depth[v[rows], u[rows]] for depth in self.around(k)[:3]]
        return found[0], found[1], found[2]

    def common(self, frames: np.ndarray, uv: np.ndarray) -> np.ndarray:
        """Residual [k, 2] px that most of the flow from frames [k] to the next has at pixels uv [k, 2]."""
        coefficients = np.zeros((len(uv), 3, 2))
        for k, rows in by_frame(frames):
            coefficients[rows] = self.around(k).common
        return np.einsum("kc,kcx->kx", _affine(uv, self.pairs.confidence.shape[1:]), coefficients)

    def confidence(self, frames: np.ndarray, uv: np.ndarray) -> np.ndarray:
        """Confidence [k] of the flow from pixels uv [k, 2] of frames [k] to the next; 0 on what is burnt in."""
        found = np.zeros(len(uv))
        u, v = np.rint(uv).astype(int).T
        for k, rows in by_frame(frames):
            found[rows] = self.pairs.confidence[self.pairs.edges[k, k + 1]][v[rows], u[rows]]
        return found if self.pairs.scene is None else found * self.pairs.scene[v, u]

    def patches(self, frames: np.ndarray, uv: np.ndarray, size_px: int) -> np.ndarray:
        """Detail [k, size_px^2] of squares around pixels uv [k, 2] of frames [k]."""
        found = np.zeros((len(uv), size_px**2), np.float32)
        for k, rows in by_frame(frames):
            found[rows] = patches(self.around(k).detail, uv[rows], size_px)
        return found


def _around(
    pairs: FlowPairs,
    rgb: np.ndarray,
    cameras: tuple[np.ndarray, np.ndarray],
    inverse_depth: np.ndarray,
    residual: np.ndarray,
    k: int,
) -> Surroundings:
    """The `Surroundings` of frame k; the other arguments are those of `StaticScene`."""
    own, far, near = static_depths(inverse_depth[k].astype(np.float32), residual[k])
    far, near = np.minimum(far, own), np.maximum(near, own)
    detail = np.ascontiguousarray(log_detail(rgb[k])[..., 1])  # a view would keep its other channel too
    return Surroundings(far, near, own, detail, _common(pairs, cameras, k, far, near))


def _common(
    pairs: FlowPairs, cameras: tuple[np.ndarray, np.ndarray], k: int, far: np.ndarray, near: np.ndarray
) -> np.ndarray:
    """Coefficients [3, 2] of `Surroundings.common`, by iteratively reweighted least squares."""
    edge = pairs.edges.get((k, k + 1))
    if edge is None:
        return np.zeros((3, 2))
    grid = slice(COARSE // 2, None, COARSE), slice(COARSE // 2, None, COARSE)
    uv = pairs.pixels[grid].reshape(-1, 2).astype(float)
    moved = uv + pairs.flow[edge][grid].reshape(-1, 2)
    poses, Ks = cameras
    A, b = projection((poses[k], Ks[k]), (poses[k + 1], Ks[k + 1]))
    projected = Projected(A, b, uv)
    residual = moved - projected.at(np.clip(projected.nearest(moved), far[grid].ravel(), near[grid].ravel()))
    basis, confidence = _affine(uv, pairs.confidence.shape[1:]), pairs.confidence[edge][grid].ravel().astype(float)
    left, weight = residual, confidence
    for scale_px in np.repeat(COMMON_PX, ITERATIONS):
        weighted = basis * weight[:, None]
        common = np.linalg.solve(weighted.T @ basis + RIDGE * np.eye(3), weighted.T @ residual)
        left = residual - basis @ common
        weight = confidence / (1 + (left**2).sum(axis=1) / scale_px**2) ** 2
    return np.asarray(common)


def _affine(uv: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """1 and the coordinates of pixels uv [k, 2], in half widths from the centre of a frame of size h, w, [k, 3]."""
    h, w = size
    return np.column_stack([np.ones(len(uv)), (uv - [(w - 1) / 2, (h - 1) / 2]) / (w / 2)])


def by_frame(frames: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """Each of the frames [k], and the rows in which it is."""
    order = np.argsort(frames, kind="stable")
    found, begins = np.unique(frames[order], return_index=True)
    return list(zip(found.tolist(), np.split(order, begins[1:]), strict=True))
