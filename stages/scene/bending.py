"""Evidence for movers that bend: what a smooth change of shape explains of their flow beside rigid motion.

A mover is rigid if one motion per frame and one depth per pixel explain its flow to all frames nearby, however deep it
is. What these leave is predicted by a polynomial of the pixel, fitted to other pixels. Errors of the flow are smooth
too, and so is what rolling shutters and lenses do; all of these are as large on the static scene, which does not bend.
The same is therefore measured on static patches of the movers' shapes: the noise of the measurement.
"""

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np

from stages.scene import rigid_motion
from stages.scene.geometry import BLOCK_PX, LONGEST, RIDGE
from stages.scene.observed import Observed
from stages.scene.rigid_motion import Patch
from stages.scene.weigh import Bought, weigh
from stages.shared.warp import warp

FRAMES, REGIONS = 12, 4
"""Frames whose movers are judged, spread over the clip, and how many regions of a frame, the largest ones."""
MARGIN_PX = 2
"""At the border of a mover the flow is in part that of what is behind."""
BACK_PX = 0.5
"""Flow is trusted that leads back to within this distance. Its confidence is not asked: that of flow which is not
affine within a few pixels is low, as at motion boundaries, but so may be the flow of what bends."""
POINTS, MIN_POINTS, MIN_FITTED = 400, 60, 30
"""Pixels of a patch: at most, at least, and at least of those fitted to a frame."""
STATIC_SHARE = 0.9
"""Of the pixels of a patch that is compared with a mover."""
DEGREE = 4
"""Of the polynomial of the pixel by which shapes change."""
MOST_PX = 1.0
"""Errors count up to here: larger ones are mostly wrong matches, a few of which would outweigh a frame."""
IRLS_STEPS = 5
LEAST_RESIDUAL_PX = 0.05


class Bending(NamedTuple):
    """What bending buys over rigid motion for movers, and in px for static patches of their shapes (the median one).

    None where the static scene has no room for such a patch: then nothing is known of the noise.
    """

    bought: Bought
    static_px: float | None


class _Errors(NamedTuple):
    """Errors [n] px of rigid motion and of bending, of an instance, or of a static patch instead of it."""

    instance: int
    frame: int
    static: bool
    rigid: np.ndarray
    bent: np.ndarray


class _Near(NamedTuple):
    """Edges [E] from a frame to those up to LONGEST away: flow [E, h, w, 2], and where it leads back [E, h, w] bool."""

    edges: np.ndarray
    flow: np.ndarray
    back: np.ndarray


def bending_evidence(seen: Observed) -> dict[int, Bending]:
    """What bending buys for each instance."""
    found = []
    frames = np.unique(np.linspace(0, len(seen.rgb) - 1, FRAMES).astype(int))
    for n, k in enumerate(frames):
        # The shape of fewer pixels would be too few elsewhere, and a speck has thousands of places.
        movers = [(instance, mask) for instance, mask in _movers(seen, k) if mask.sum() >= MIN_POINTS]
        near = _near(seen, k) if movers else None
        for instance, mask in movers:
            beside = _static_patch(seen, k, mask, (n + 0.5) / len(frames))
            for static, where in ((False, mask), (True, beside)):
                patch = None if where is None or near is None else _patch(seen, k, near, where)
                if patch is not None:
                    errors = (np.clip(part, -MOST_PX, MOST_PX) for part in held_out_errors(patch))
                    found.append(_Errors(instance, k, static, *errors))
    numbers = sorted({errors.instance for errors in found})
    return {n: _weigh([errors for errors in found if errors.instance == n]) for n in numbers}


def held_out_errors(patch: Patch) -> tuple[np.ndarray, np.ndarray]:
    """Errors [n] in px of the flow of a patch, both components: of rigid motion, and of a shape that changes beside it.

    Each half of the blocks of pixels is predicted by the motions, and the change, of the other half; and by the depth
    that is seen in the other frames.
    """
    blocks = patch.uv // max(BLOCK_PX, 2 * _spacing(patch.uv))
    odd = blocks.sum(axis=1) % 2 == 1
    centred = patch.uv - patch.uv.mean(axis=0)
    x, y = (centred / max(float(np.abs(centred).max()), 1.0)).T
    terms = np.stack([x**i * y**j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)], axis=-1)
    stiff, bent = [np.zeros(0)], [np.zeros(0)]
    for half in (odd, ~odd):
        enough = (patch.good & ~half).sum(axis=1) >= MIN_FITTED
        if not enough.any():
            continue
        left = rigid_motion.residuals(patch, rigid_motion.fit(patch.part(~half)))
        change = _predicted(terms, left, patch.good & ~half)
        judged = patch.good & half & enough[:, None]
        stiff.append(left[judged].ravel())
        bent.append((left - change)[judged].ravel())
    return np.concatenate(stiff), np.concatenate(bent)


def _predicted(terms: np.ndarray, values: np.ndarray, fitted: np.ndarray) -> np.ndarray:
    """Values [E, P, 2] of the combination of terms [P, n] that fits them best (L1) where `fitted` [E, P]."""
    weight, found = fitted.astype(float), np.zeros_like(values)
    n = terms.shape[1]
    for _ in range(IRLS_STEPS):
        weighted = weight[..., None] * terms
        normal = np.swapaxes(weighted, 1, 2) @ terms
        normal += (RIDGE * np.trace(normal, axis1=1, axis2=2) / n**2 + 1e-9)[:, None, None] * np.eye(n)
        found = terms @ np.linalg.solve(normal, np.swapaxes(weighted, 1, 2) @ values)
        weight = fitted / np.maximum(np.linalg.norm(values - found, axis=-1), LEAST_RESIDUAL_PX)
    return np.asarray(found)


def _movers(seen: Observed, k: int) -> Iterator[tuple[int, np.ndarray]]:
    """Instance and mask [h, w] of each connected moving region of a frame, without its border."""
    numbers = seen.instances[k] * seen.dynamic[k]
    kernel = np.ones((2 * MARGIN_PX + 1,) * 2, np.uint8)
    regions = []
    for instance in np.unique(numbers[numbers > 0]).tolist():
        _, labels = cv2.connectedComponents((numbers == instance).astype(np.uint8))
        regions += [
            (area, instance, labels == label) for label, area in enumerate(np.bincount(labels.ravel())) if label
        ]
    for _, instance, region in sorted(regions, key=lambda of: -of[0])[:REGIONS]:
        yield instance, cv2.erode(region.astype(np.uint8), kernel, borderValue=1) > 0


def _static_patch(seen: Observed, k: int, mask: np.ndarray, place: float) -> np.ndarray | None:
    """Static pixels [h, w] where the mask is shifted to, by multiples of half its size; None if there are too few.

    Args:
        place: 0..1, from the first of the possible places, at the top, to the last.
    """
    static = cv2.dilate(seen.dynamic[k].astype(np.uint8), np.ones((2 * MARGIN_PX + 1,) * 2, np.uint8)) == 0
    if seen.scene is not None:
        static &= seen.scene
    u, v, width, height = cv2.boundingRect(mask.astype(np.uint8))
    shape = mask[v : v + height, u : u + width]
    sides = zip(mask.shape, shape.shape, strict=True)
    rows, columns = (range(0, size - side + 1, max(side // 2, 1)) for size, side in sides)
    windows = [(slice(row, row + height), slice(column, column + width)) for row in rows for column in columns]
    free = [at for at in windows if static[at][shape].mean() >= STATIC_SHARE] if shape.any() else []
    if not free:
        return None
    at, patch = free[int(place * len(free))], np.zeros_like(mask)
    patch[at] = shape & static[at]
    return patch


def _near(seen: Observed, k: int) -> _Near | None:
    """The flow from a frame, read once for all of its movers; None where it has no edge."""
    edges = np.flatnonzero((seen.edges[:, 0] == k) & (np.abs(seen.offsets) <= LONGEST))
    if not len(edges):
        return None
    flow = np.stack([seen.at_once(int(e)) for e in edges])
    return _Near(edges, flow, np.stack([_leads_back(seen, int(e)) for e in edges]))


def _patch(seen: Observed, k: int, near: _Near, mask: np.ndarray) -> Patch | None:
    """Pixels of a mask with their flow to frames up to LONGEST away; None if there are too few."""
    step = max(int(np.ceil((mask.sum() / POINTS) ** 0.5)), 1)
    chosen = np.zeros_like(mask)
    chosen[::step, ::step] = mask[::step, ::step]
    good = near.back[:, chosen]
    sure = good.sum(axis=1) >= MIN_POINTS
    tracked = good[sure].sum(axis=0) >= 2
    if tracked.sum() < MIN_POINTS:
        return None
    uv, flow = np.argwhere(chosen)[tracked, ::-1].astype(float), near.flow[sure][:, chosen][:, tracked].astype(float)
    return Patch(uv, flow, good[sure][:, tracked], seen.Ks[k], seen.Ks[seen.edges[near.edges[sure], 1]])


def _leads_back(seen: Observed, edge: int) -> np.ndarray:
    """Pixels [h, w] whose flow along an edge is known, ends in the frame, and returns along the opposite edge."""
    opposite = np.flatnonzero((seen.edges == seen.edges[edge, ::-1]).all(axis=1))[0]
    there = seen.flow[edge]
    apart = np.linalg.norm(there + warp(seen.flow[opposite], there), axis=-1)
    return np.asarray((apart < BACK_PX) & (seen.confidence[edge] > 0))


def _spacing(uv: np.ndarray) -> float:
    """Least distance between columns or rows of pixels; inf for a single one."""
    return float(min(np.diff(np.unique(along)).min(initial=np.inf) for along in uv.T))


def _weigh(found: list[_Errors]) -> Bending:
    """What bending buys in errors of movers, with its uncertainty over the frames, and in those of static patches."""
    movers = [errors for errors in found if not errors.static]
    frames = [np.full(len(errors.bent), errors.frame) for errors in movers]
    sides = [errors.rigid for errors in movers], [errors.bent for errors in movers], frames
    bought = weigh(*(np.concatenate([np.zeros(0), *side]) for side in sides))
    # A mover that no mask covers is in few of them.
    saved = [np.square(e.rigid).mean() - np.square(e.bent).mean() for e in found if e.static and len(e.rigid)]
    return Bending(bought, max(float(np.median(saved)), 0.0) ** 0.5 if saved else None)
