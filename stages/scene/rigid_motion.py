"""Rigid motion of a patch of a frame to others, with free depth: what of its flow do motion and relief explain?

A pixel with ray p and inverse depth d goes to K' (R p + d t) in another frame. Each frame has a motion R, t of its own,
which is that of the thing and the camera together; the depth of a pixel is the same for all of them. The unit of
length is the mean distance, so that d is 1 + relief.
"""

from typing import NamedTuple

import numpy as np

from stages.shared import lie

STEPS, STIFF_STEPS = 11, 3
"""Of all parameters, and how many of these before the relief may change."""
RELIEF_STEPS = 4
LEAST_RESIDUAL_PX = 0.1
"""Below, all residuals count by their squares; above, by their size: an error of the flow does not tilt the fit."""
PRIOR = 0.1 / 0.3**2
"""A relief of 0.3 costs as much as a residual of 0.1 px: what the flow does not determine stays flat."""
MOST_RELIEF = (-0.7, 1.5)
DAMPING = 1e-5
NEAREST = 0.05


class Patch(NamedTuple):
    """P pixels of a frame and their flow to E others.

    Attributes:
        uv: [P, 2] px. flow: [E, P, 2] px, anything where it is not good, NaN too. good: [E, P] bool, where it can be
            trusted. K: [3, 3]. Ks: [E, 3, 3], of the other frames.
    """

    uv: np.ndarray
    flow: np.ndarray
    good: np.ndarray
    K: np.ndarray
    Ks: np.ndarray

    def part(self, pixels: np.ndarray) -> "Patch":
        """Some of its pixels."""
        return Patch(self.uv[pixels], self.flow[:, pixels], self.good[:, pixels], self.K, self.Ks)


class Motion(NamedTuple):
    """Rotations [E, 3, 3] and translations [E, 3] of a patch to other frames, in mean distances."""

    R: np.ndarray
    t: np.ndarray


def fit(patch: Patch) -> Motion:
    """The motions that fit the flow best (L1), whatever the relief: Gauss-Newton with the relief eliminated.

    A hollow that turns one way moves almost as a bulge that turns the other way. The descent therefore begins at a dome
    and at its reverse, with motions that fit these, and the better end is kept.
    """
    t = np.zeros((len(patch.flow), 3))
    for shift, flow, good in zip(t, patch.flow, patch.good, strict=True):
        if good.any():
            shift[:2] = np.median(flow[good], axis=0) / patch.K.diagonal()[:2]
    start = Motion(np.tile(np.eye(3), (len(t), 1, 1)), t)
    across = (patch.uv - patch.uv.mean(axis=0)) / patch.K.diagonal()[:2]
    size = max(float(np.abs(across).max()), 1e-6)
    dome = size - np.square(across).sum(axis=1) / size
    return min((_descend(patch, start, relief) for relief in (dome, -dome)), key=lambda end: end[0])[1]


def _descend(patch: Patch, motion: Motion, relief: np.ndarray) -> tuple[float, Motion]:
    """Sum of the residuals, and the motions."""
    for step in range(STEPS):
        motion, relief = _step(patch, motion, relief, stiff=step < STIFF_STEPS)
    left = _linear(patch, motion, relief)[0]
    return float(np.linalg.norm(left, axis=-1)[patch.good].sum()), motion


def residuals(patch: Patch, motion: Motion) -> np.ndarray:
    """What motions leave of the flow [E, P, 2] in px, with the relief that all other frames but the judged one show."""
    relief = np.zeros(len(patch.uv))
    for _ in range(RELIEF_STEPS):
        left, weight, _, slope = _linear(patch, motion, relief)
        scatter, pull = _by_relief(left, weight, slope)
        relief = np.clip(relief + _relief_step(scatter.sum(axis=0), pull.sum(axis=0), relief), *MOST_RELIEF)
    left, weight, _, slope = _linear(patch, motion, relief)
    scatter, pull = _by_relief(left, weight, slope)
    others = _relief_step(scatter.sum(axis=0) - scatter, pull.sum(axis=0) - pull, relief)
    return np.asarray(left - slope * others[..., None])


def _linear(patch: Patch, motion: Motion, relief: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Residuals [E, P, 2], their weights [E, P], and slopes of the pixel by the motion [E, P, 2, 6] and the relief."""
    focal = patch.Ks[:, None, [0, 1], [0, 1]]
    rays = np.concatenate([(patch.uv - patch.K[:2, 2]) / patch.K.diagonal()[:2], np.ones((len(patch.uv), 1))], axis=1)
    turned = np.einsum("eij,pj->epi", motion.R, rays)
    x, y, z = np.moveaxis(turned + (1 + relief)[:, None] * motion.t[:, None], -1, 0)
    z = np.maximum(z, NEAREST)
    seen = np.stack([x / z, y / z], axis=-1)
    # A match that cannot be trusted leaves nothing: a weight of 0 would still carry a NaN of it into every sum.
    left = np.where(patch.good[..., None], patch.uv + patch.flow - focal * seen - patch.Ks[:, None, :2, 2], 0.0)
    weight = patch.good / np.maximum(np.linalg.norm(left, axis=-1), LEAST_RESIDUAL_PX)
    by_point = np.zeros((*left.shape, 3))
    by_point[..., [0, 1], [0, 1]] = focal / z[..., None]
    by_point[..., 2] = -focal * seen / z[..., None]
    by_turn, by_shift = lie.cross(turned[:, :, None], by_point), by_point * (1 + relief)[:, None, None]
    by_motion = np.concatenate([by_turn, by_shift], axis=-1)
    return left, weight, by_motion, np.einsum("epij,ej->epi", by_point, motion.t)


def _step(patch: Patch, motion: Motion, relief: np.ndarray, stiff: bool) -> tuple[Motion, np.ndarray]:
    """A step of the motions and the relief, or of the motions alone if the relief is `stiff`."""
    left, weight, A, slope = _linear(patch, motion, relief)
    if stiff:
        slope = np.zeros_like(slope)
    E, n = len(left), A.shape[-1]
    weighted = A * weight[..., None, None]
    scatter, pull = (part.sum(axis=0) for part in _by_relief(left, weight, slope))
    mixed = np.einsum("epck,epc->epk", weighted, slope)
    below = scatter + PRIOR
    rows, at = np.moveaxis(mixed, 1, 2).reshape(E * n, -1), np.arange(E)
    normal = -((rows / below) @ rows.T).reshape(E, n, E, n)
    own = np.swapaxes(weighted.reshape(E, -1, n), 1, 2) @ A.reshape(E, -1, n)
    normal[at, :, at] += own + DAMPING * own * np.eye(n) + 1e-9 * np.eye(n)
    flat = _relief_step(scatter, pull, relief)
    right = np.einsum("epck,epc->ek", weighted, left) - np.einsum("epk,p->ek", mixed, flat)
    change = np.linalg.solve(normal.reshape(E * n, E * n), right.ravel()).reshape(E, n)
    moved = Motion(lie.exp_so3(change[:, :3]) @ motion.R, motion.t + change[:, 3:])
    if stiff:
        return moved, relief
    relief = relief + flat - np.einsum("epk,ek->p", mixed, change) / below
    return moved, np.clip(relief, *MOST_RELIEF)


def _by_relief(left: np.ndarray, weight: np.ndarray, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations [E, P] of the relief, frame by frame: scatter and right-hand side."""
    return weight * np.square(slope).sum(axis=-1), weight * (slope * left).sum(axis=-1)


def _relief_step(scatter: np.ndarray, pull: np.ndarray, relief: np.ndarray) -> np.ndarray:
    return np.asarray((pull - PRIOR * relief) / (scatter + PRIOR))
