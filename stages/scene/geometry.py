"""Evidence from geometry: moving parts, translation of the camera, non-rigid movers."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from stages.scene.observed import Observed, static_motion
from stages.shared.cameras import pixel_grid, projection, static_flow

MIN_CONFIDENCE = 0.3
SAMPLED_EDGES = 24
LONGEST = 5
MIN_REGION_PX = 40
IRLS_STEPS = 8


def dynamic_evidence(seen: Observed) -> dict[str, float]:
    """Share of the pixels that masks cover, and residuals of the flow to a static scene inside and outside them.

    The longest edges up to LONGEST frames are used: slow motion adds up over them; over longer ones too little is
    still in view.
    """
    inside, outside = [], []
    distances = np.abs(seen.offsets)
    for edge in _spread_edges(seen, distances[distances <= LONGEST].max(initial=distances.min(initial=LONGEST))):
        residual = _static_residual(seen, edge)
        trusted = seen.confidence[edge] >= MIN_CONFIDENCE
        dynamic = seen.dynamic[seen.edges[edge, 0]]
        inside.append(residual[trusted & dynamic])
        outside.append(residual[trusted & ~dynamic])
    return {
        "mask_share": float(seen.dynamic.mean()),
        "residual_inside_px": _median(inside),
        "residual_outside_px": _median(outside),
    }


def parallax_evidence(seen: Observed) -> dict[str, float]:
    """How far the camera's travel moves static pixels, beyond what its turning does, over the most distant frames."""
    F, h, w = seen.depth.shape
    parallax = []
    for source, target in {(0, F - 1), (0, F // 2), (F // 2, F - 1)}:
        cameras = ((seen.cam_from_world[k], seen.Ks[k]) for k in (source, target))
        A, b = projection(*cameras)
        inverse_depth = 1 / seen.depth[source].astype(float)
        moved, turned = (static_flow(pixel_grid(h, w), inverse_depth, A, way)[0] for way in (b, 0 * b))
        shift = np.linalg.norm(moved - turned, axis=-1)
        parallax.append(float(np.median(shift[~seen.dynamic[source]])) if not seen.dynamic[source].all() else 0.0)
    return {"parallax_px": max(parallax), "parallax_share_of_width": max(parallax) / w}


class Region(NamedTuple):
    """A connected moving region of a frame: its instance, and of its pixels, in px, the residual of the flow to the
    best planar rigid motion and the distance of the flow from its median."""

    instance: int
    residual: np.ndarray
    spread: np.ndarray


def moving_regions(seen: Observed) -> list[Region]:
    """Moving regions of frames over the clip, by their flow to the next frame.

    The flow of a rigid plane is quadratic in the pixel with eight parameters (Longuet-Higgins and Prazdny 1980);
    a moderately curved rigid body comes close to one.
    """
    regions = []
    for edge in _spread_edges(seen, 1):
        frame = seen.edges[edge, 0]
        confident = seen.confidence[edge] >= MIN_CONFIDENCE
        numbers = seen.instances[frame] * seen.dynamic[frame]
        for instance in np.unique(numbers[numbers > 0]).tolist():
            count, labels = cv2.connectedComponents((numbers == instance).astype(np.uint8))
            for label in range(1, count):
                chosen = (labels == label) & confident
                if chosen.sum() >= MIN_REGION_PX:
                    regions.append(
                        _region(instance, np.argwhere(chosen)[:, ::-1], seen.flow[edge][chosen].astype(float))
                    )
    return regions


def _region(instance: int, uv: np.ndarray, flow: np.ndarray) -> Region:
    spread = np.linalg.norm(flow - np.median(flow, axis=0), axis=1)
    return Region(instance, planar_residual(uv, flow), spread)


def bending_evidence(seen: Observed, regions: Sequence[Region]) -> dict[str, float]:
    """Residual of moving regions to rigid motion and spread of their flow, in px, and the share that they cover."""
    shares = [float(seen.dynamic[seen.edges[edge, 0]].mean()) for edge in _spread_edges(seen, 1)]
    return bending_of(regions) | {"area_share": float(np.median(shares)) if shares else 0.0}


def bending_of(regions: Sequence[Region]) -> dict[str, float]:
    """Median residual to rigid motion and median spread of the flow over the pixels of regions, in px; 0 of none."""
    return {
        "bending_px": _median([region.residual for region in regions]),
        "flow_spread_px": _median([region.spread for region in regions]),
    }


def bending_of_instances(regions: Sequence[Region]) -> dict[int, dict[str, float]]:
    """The same by instance."""
    numbers = sorted({region.instance for region in regions})
    return {n: bending_of([region for region in regions if region.instance == n]) for n in numbers}


def planar_residual(uv: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """Distance [n] in px of flow [n, 2] at pixels uv [n, 2] from the robustly fitted flow of a rigid plane."""
    centred = uv - uv.mean(axis=0)
    x, y = (centred / max(float(np.abs(centred).max()), 1.0)).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    rows_u = np.stack([one, x, y, zero, zero, zero, x * x, x * y], axis=-1)
    rows_v = np.stack([zero, zero, zero, one, x, y, x * y, y * y], axis=-1)
    design = np.stack([rows_u, rows_v], axis=1)
    weights = np.ones(len(uv))
    for _ in range(IRLS_STEPS):  # L1 by reweighting, so that a limb does not tilt the fit of the body
        weighted = design * weights[:, None, None]
        normal = np.einsum("nci,ncj->ij", weighted, design)
        solution = np.linalg.lstsq(normal, np.einsum("nci,nc->i", weighted, flow), rcond=None)[0]
        distance = np.linalg.norm(flow - design @ solution, axis=1)
        weights = 1 / np.maximum(distance, 0.05)
    return distance


def _static_residual(seen: Observed, edge: int) -> np.ndarray:
    """Distance [h, w] in px between the flow of an edge and that of a static scene."""
    return np.asarray(np.linalg.norm(seen.flow[edge] - static_motion(seen, *seen.edges[edge])[0], axis=-1))


def _spread_edges(seen: Observed, offset: int) -> np.ndarray:
    """At most SAMPLED_EDGES edges of this frame distance, spread over the clip."""
    rows = np.flatnonzero(np.abs(seen.offsets) == offset)
    return rows[np.unique(np.linspace(0, len(rows) - 1, min(SAMPLED_EDGES, len(rows))).astype(int))]


def _median(parts: list[np.ndarray]) -> float:
    """Median of all parts; 0 where there is nothing."""
    values = np.concatenate(parts) if parts else np.zeros(0)
    return float(np.median(values)) if len(values) else 0.0
