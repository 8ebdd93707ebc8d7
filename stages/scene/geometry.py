"""Evidence from the flow: what moving parts and their bending explain of it.

Each is a model of the flow that is judged against a simpler one, in px, on samples that it was not fitted to.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from stages.scene.observed import Observed, static_motion
from stages.scene.weigh import Bought, weigh

MIN_CONFIDENCE = 0.3
SAMPLED_EDGES = 24
LONGEST = 5
MIN_REGION_PX = 40
BLOCK_PX = 4
"""Side of the blocks of pixels that are fitted and held out in turn, as on a chessboard."""
IRLS_STEPS = 8
LEAST_RESIDUAL_PX = 0.05
DEGREE = 4
"""Of the polynomial flow that a bending region may have."""
RIDGE = 1e-3


class MaskEvidence(NamedTuple):
    """What the motion of masked regions explains of their flow, over a static scene, and the residuals to that in px.

    Attributes:
        share: of the pixels that masks cover. inside_px, outside_px: median residual of a static scene.
    """

    bought: Bought
    share: float
    inside_px: float
    outside_px: float


class Region(NamedTuple):
    """A connected moving region of a frame, with the errors [n] in px of held-out flow, both components.

    Attributes:
        edge: row of the flow. instance: its number. static, plane, bent: errors [n] of the flow of the static scene, of
            a rigid plane and of a bending surface. spread: distance [m] in px of the flow from its median.
    """

    edge: int
    instance: int
    static: np.ndarray
    plane: np.ndarray
    bent: np.ndarray
    spread: np.ndarray


def dynamic_evidence(seen: Observed) -> MaskEvidence:
    """What a rigid plane's motion of each region buys over a static scene, and how many pixels masks cover.

    The longest edges up to LONGEST frames are used: slow motion adds up over them; over longer ones too little is
    still in view. Where the flow of no region can be trusted over these, as that of fast movers, shorter ones are used.
    """
    distances = np.abs(seen.offsets)
    offsets = np.unique(distances[distances <= LONGEST])[::-1].tolist() or [distances.min(initial=LONGEST)]
    for offset in offsets:
        regions = moving_regions(seen, offset)
        if regions:
            break
    inside, outside = [], []
    for edge in _spread_edges(seen, offset):
        residual = np.linalg.norm(_static_residual(seen, edge), axis=-1)
        trusted = seen.confidence[edge] >= MIN_CONFIDENCE
        dynamic = seen.dynamic[seen.edges[edge, 0]]
        inside.append(residual[trusted & dynamic])
        outside.append(residual[trusted & ~dynamic])
    bought = _weigh_regions(regions, [region.static for region in regions], [region.plane for region in regions])
    return MaskEvidence(bought, float(seen.dynamic.mean()), _median(inside), _median(outside))


def moving_regions(seen: Observed, offset: int = 1) -> list[Region]:
    """Moving regions of frames over the clip, by their flow to the frame `offset` away.

    The flow of a rigid plane is quadratic in the pixel with eight parameters (Longuet-Higgins and Prazdny 1980);
    a moderately curved rigid body comes close to one.
    """
    regions = []
    for edge in _spread_edges(seen, offset):
        frame = seen.edges[edge, 0]
        confident = seen.confidence[edge] >= MIN_CONFIDENCE
        numbers = seen.instances[frame] * seen.dynamic[frame]
        residual = _static_residual(seen, edge)
        for instance in np.unique(numbers[numbers > 0]).tolist():
            count, labels = cv2.connectedComponents((numbers == instance).astype(np.uint8))
            for label in range(1, count):
                chosen = (labels == label) & confident
                if chosen.sum() >= MIN_REGION_PX:
                    uv, flow = np.argwhere(chosen)[:, ::-1], seen.flow[edge][chosen].astype(float)
                    plane, bent = held_out_errors(uv, flow)
                    spread = np.linalg.norm(flow - np.median(flow, axis=0), axis=1)
                    regions.append(Region(edge, instance, residual[chosen].ravel(), plane, bent, spread))
    return regions


def bending_of(regions: Sequence[Region]) -> tuple[Bought, float]:
    """What bending explains of the flow of regions, over rigid planes, and the median spread of the flow in px."""
    bought = _weigh_regions(regions, [region.plane for region in regions], [region.bent for region in regions])
    return bought, _median([region.spread for region in regions])


def bending_of_instances(regions: Sequence[Region]) -> dict[int, tuple[Bought, float]]:
    """The same by instance."""
    numbers = sorted({region.instance for region in regions})
    return {n: bending_of([region for region in regions if region.instance == n]) for n in numbers}


def held_out_errors(uv: np.ndarray, flow: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors [2 n] in px of flow [n, 2] at pixels uv [n, 2]: of a rigid plane's flow, and of a bending surface's.

    Each half of the blocks is predicted from the other half.
    """
    centred = uv - uv.mean(axis=0)
    x, y = (centred / max(float(np.abs(centred).max()), 1.0)).T
    designs = _plane_design(x, y), _bent_design(x, y)
    odd = (uv // BLOCK_PX).sum(axis=1) % 2 == 1
    errors = []
    for design in designs:
        error = np.zeros_like(flow)
        for half in (odd, ~odd):
            error[half] = flow[half] - design[half] @ _fitted(design[~half], flow[~half])
        errors.append(error.ravel())
    return errors[0], errors[1]


def _plane_design(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Flow [n, 2, 8] of a rigid plane at pixels x, y by its parameters."""
    zero, one = np.zeros_like(x), np.ones_like(x)
    rows_u = np.stack([one, x, y, zero, zero, zero, x * x, x * y], axis=-1)
    rows_v = np.stack([zero, zero, zero, one, x, y, x * y, y * y], axis=-1)
    return np.stack([rows_u, rows_v], axis=1)


def _bent_design(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Flow [n, 2, K] of a bending surface: polynomials up to DEGREE in each component."""
    terms = np.stack([x**i * y**j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)], axis=-1)
    zero = np.zeros_like(terms)
    return np.stack([np.concatenate([terms, zero], -1), np.concatenate([zero, terms], -1)], axis=1)


def _fitted(design: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """Parameters that fit flow [n, 2] best by L1, so that a limb does not tilt the fit of the body."""
    weights, solution = np.ones(len(flow)), np.zeros(design.shape[-1])
    for _ in range(IRLS_STEPS if len(flow) else 0):
        weighted = design * weights[:, None, None]
        normal = np.tensordot(weighted, design, ((0, 1), (0, 1)))
        normal += RIDGE * np.trace(normal) / len(normal) ** 2 * np.eye(len(normal))
        solution = np.linalg.lstsq(normal, np.tensordot(weighted, flow, ((0, 1), (0, 1))), rcond=None)[0]
        distance = np.linalg.norm(flow - design @ solution, axis=1)
        weights = 1 / np.maximum(distance, LEAST_RESIDUAL_PX)
    return np.asarray(solution)


def _weigh_regions(regions: Sequence[Region], simple: list[np.ndarray], rich: list[np.ndarray]) -> Bought:
    """What the richer errors save, with its uncertainty over the frames."""
    groups = [np.full(len(errors), region.edge) for region, errors in zip(regions, rich, strict=True)]
    none = [np.zeros(0)]
    return weigh(*(np.concatenate([*none, *part]) for part in (simple, rich, groups)))


def _static_residual(seen: Observed, edge: int) -> np.ndarray:
    """Difference [h, w, 2] in px of the flow of an edge from that of a static scene."""
    return np.asarray(seen.flow[edge] - static_motion(seen, *seen.edges[edge])[0])


def _spread_edges(seen: Observed, offset: int) -> np.ndarray:
    """At most SAMPLED_EDGES edges of this frame distance, spread over the clip."""
    rows = np.flatnonzero(np.abs(seen.offsets) == offset)
    return rows[np.unique(np.linspace(0, len(rows) - 1, min(SAMPLED_EDGES, len(rows))).astype(int))]


def _median(parts: list[np.ndarray]) -> float:
    """Median of all parts; 0 where there is nothing."""
    values = np.concatenate(parts) if parts else np.zeros(0)
    return float(np.median(values)) if len(values) else 0.0
