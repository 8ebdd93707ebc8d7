"""Evidence from the flow for a camera that travels: what that explains beside turning."""

import numpy as np

from stages.scene.geometry import LEAST_RESIDUAL_PX, MIN_CONFIDENCE
from stages.scene.observed import Observed
from stages.scene.sightings import CELLS
from stages.scene.weigh import Bought, weigh
from stages.shared.cameras import pixel_grid, projection, static_flow

FRAMES, STRIDE_PX = 12, 4
"""Frames that are judged, and the step between their pixels each way."""
MIN_PIXELS = 16
IRLS_STEPS = 5
FOCAL_STEP = 1e-3


def travel_evidence(seen: Observed) -> Bought:
    """What the camera's travel explains of the static flow, in px, over a camera that turns as fits the flow best.

    The depth of a pixel is that of its flow to all other frames but the one that is judged. Turning, and an error of
    the focal length, which looks like travel, are those of the other half of the image.
    """
    parts = [(np.zeros(0), np.zeros(0), np.zeros(0, int))]
    for k in np.unique(np.linspace(0, len(seen.rgb) - 1, FRAMES).astype(int)):
        turned, travelled = _errors_of_frame(seen, int(k))
        parts.append((turned, travelled, np.full(len(turned), k)))
    return weigh(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _errors_of_frame(seen: Observed, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors [n] in px of the static flow from frame k: of a camera that turns, and of one that travels."""
    h, w = seen.dynamic.shape[1:]
    edges = np.flatnonzero(seen.edges[:, 0] == k)
    uv = pixel_grid(h, w)[::STRIDE_PX, ::STRIDE_PX].reshape(-1, 2)
    u, v = uv.astype(int).T
    static = ~seen.dynamic[k, v, u]
    uv, u, v = uv[static], u[static], v[static]
    odd = (v * CELLS[0] // h + u * CELLS[1] // w) % 2 == 1
    cameras = [(seen.cam_from_world[j], seen.Ks[j]) for j in (k, *seen.edges[edges, 1])]
    maps = [projection(cameras[0], camera) for camera in cameras[1:]]
    flows = np.array([seen.at_once(int(e))[v, u] for e in edges], float).reshape(len(edges), len(uv), 2)
    good = np.array([seen.confidence[e][v, u] for e in edges]).reshape(len(edges), len(uv)) >= MIN_CONFIDENCE
    sums = np.zeros((len(edges), len(uv), 2))
    for e, map_ in enumerate(maps):
        sums[e] = _triangulated(uv, flows[e], *map_) * good[e, :, None]
    total, errors = sums.sum(axis=0), [(np.zeros(0), np.zeros(0))]
    for e, (A, b) in enumerate(maps):
        above, below = np.moveaxis(total - sums[e], -1, 0)
        known = good[e] & (below > 0)
        inverse_depth = np.where(known, np.maximum(above, 0) / np.where(known, below, 1), 0.0)
        moved, ratio = static_flow(uv, inverse_depth, A, b)
        turned = _turned_flow(uv, flows[e], A, cameras[0][1], cameras[1 + e][1], good[e], odd)
        judged = known & (ratio > 0)
        errors.append(((flows[e] - turned)[judged].ravel(), (flows[e] - moved)[judged].ravel()))
    turned_errors, moved_errors = (np.concatenate(part) for part in zip(*errors, strict=True))
    return turned_errors, moved_errors


def _triangulated(uv: np.ndarray, flow: np.ndarray, A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Sums [n, 2] for the inverse depth of pixels uv [n, 2] with a flow [n, 2]: it is the first over the second.

    u' (a3 p + d b3) = a12 p + d b12 is linear in the inverse depth d; divided by a3 p its errors are pixels.
    """
    there, ray = uv + flow, uv @ A[:, :2].T + A[:, 2]
    along = (b[:2] - there * b[2]) / ray[:, 2:]
    apart = (there * ray[:, 2:] - ray[:, :2]) / ray[:, 2:]
    return np.stack([(along * apart).sum(axis=1), (along * along).sum(axis=1)], axis=-1)


def _turned_flow(
    uv: np.ndarray,
    flow: np.ndarray,
    A: np.ndarray,
    K: np.ndarray,
    other_K: np.ndarray,
    good: np.ndarray,
    odd: np.ndarray,
) -> np.ndarray:
    """Flow [n, 2] of a camera that turns, each half of the pixels by what fits the other half best (L1)."""
    start = _far_flow(uv, A)
    x, y = ((uv - K[:2, 2]) / K.diagonal()[:2]).T
    # The flow of a small rotation about x, y and z (Longuet-Higgins and Prazdny 1980), and of another focal length.
    turns = np.stack([np.stack([x * y, 1 + y * y], -1), np.stack([-(1 + x * x), -x * y], -1), np.stack([y, -x], -1)])
    longer = np.diag([1 + FOCAL_STEP, 1 + FOCAL_STEP, 1.0])
    rotation = np.linalg.inv(other_K) @ A @ K
    zoomed = _far_flow(uv, other_K @ longer @ rotation @ np.linalg.inv(K @ longer)) - start
    basis = np.stack([*(other_K.diagonal()[:2] * turns), zoomed / FOCAL_STEP], axis=-1)
    turned = start.copy()
    for half in (odd, ~odd):
        rows = np.flatnonzero(good & ~half)
        change, weight, left = np.zeros(basis.shape[-1]), np.ones(len(rows)), flow[rows] - start[rows]
        for _ in range(IRLS_STEPS if len(rows) >= MIN_PIXELS else 0):
            weighted = (basis[rows] * weight[:, None, None]).reshape(-1, basis.shape[-1])
            design = basis[rows].reshape(weighted.shape)
            change = np.linalg.lstsq(weighted.T @ design, weighted.T @ left.ravel(), rcond=1e-9)[0]
            weight = 1 / np.maximum(np.linalg.norm(left - basis[rows] @ change, axis=1), LEAST_RESIDUAL_PX)
        turned[half] = start[half] + basis[half] @ change
    return turned


def _far_flow(uv: np.ndarray, A: np.ndarray) -> np.ndarray:
    """Flow [n, 2] of what is infinitely far away."""
    return static_flow(uv, np.zeros(len(uv)), A, np.zeros(3))[0]
