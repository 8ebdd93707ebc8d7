"""Evidence from the flow for moving parts: what their own motion explains of it, on pixels not fitted to, in px."""

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np

from stages.scene.observed import Observed, static_motion
from stages.scene.weigh import Bought, weigh

MIN_CONFIDENCE = 0.3
SAMPLED_EDGES = 24
LONGEST = 5
MIN_REGION_PX = 40
TILE_PX = 48
"""Side in px of the tiles into which a region is cut that is wider or higher."""
BLOCK_PX = 4
"""Side of the blocks of pixels that are fitted and held out in turn, as on a chessboard."""
IRLS_STEPS = 8
LEAST_RESIDUAL_PX = 0.05
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
    """A moving region of a frame, of a large one a tile, with the errors [n] in px of held-out flow, both components.

    Attributes:
        edge: row of the flow. static, plane: errors [n] of the flow of the static scene, and of a rigid plane.
    """

    edge: int
    static: np.ndarray
    plane: np.ndarray


def dynamic_evidence(seen: Observed) -> MaskEvidence:
    """What a rigid plane's motion of each region buys over a static scene, and how many pixels masks cover.

    The longest edges up to LONGEST frames are used: slow motion adds up over them; over longer ones too little is
    still in view. Where the flow of no region can be trusted over these, as that of fast movers, shorter ones are used.
    """
    distances = np.abs(seen.offsets)
    offsets = np.unique(distances[distances <= LONGEST])[::-1].tolist() or [distances.min(initial=LONGEST)]
    for offset in offsets:
        regions = _moving_regions(seen, offset)
        if regions:
            break
    inside, outside = [], []
    for edge in _spread_edges(seen, offset):
        residual = np.linalg.norm(_static_residual(seen, edge), axis=-1)
        trusted = seen.confidence[edge] >= MIN_CONFIDENCE
        dynamic = seen.dynamic[seen.edges[edge, 0]]
        inside.append(residual[trusted & dynamic])
        outside.append(residual[trusted & ~dynamic])
    return MaskEvidence(_weigh_regions(regions), float(seen.dynamic.mean()), _median(inside), _median(outside))


def _moving_regions(seen: Observed, offset: int) -> list[Region]:
    """Moving regions of frames over the clip, by their flow to the frame `offset` away.

    The flow of a rigid plane is quadratic in the pixel with eight parameters (Longuet-Higgins and Prazdny 1980);
    a moderately curved rigid body comes close to one.
    """
    regions = []
    for edge in _spread_edges(seen, offset):
        frame = seen.edges[edge, 0]
        confident = seen.confidence[edge] >= MIN_CONFIDENCE
        residual = _static_residual(seen, edge)
        for part in _parts(seen.instances[frame] * seen.dynamic[frame]):
            chosen = part & confident
            if chosen.sum() >= MIN_REGION_PX:
                plane = plane_errors(np.argwhere(chosen)[:, ::-1], seen.at_once(edge)[chosen].astype(float))
                regions.append(Region(edge, residual[chosen].ravel(), plane))
    return regions


def _parts(numbers: np.ndarray) -> Iterator[np.ndarray]:
    """What [h, w] bool moves as one thing: connected parts of instances [h, w], of the larger ones single tiles.

    What fills much of the view bends, or is several things: no plane moves as all of it.
    """
    rows, columns = (np.arange(length) // TILE_PX for length in numbers.shape)
    tiles = rows[:, None] * len(columns) + columns
    for instance in np.unique(numbers[numbers > 0]).tolist():
        count, labels = cv2.connectedComponents((numbers == instance).astype(np.uint8))
        for label in range(1, count):
            part = labels == label
            if np.ptp(np.argwhere(part), axis=0).max() < TILE_PX:
                yield part
            else:
                yield from (part & (tiles == tile) for tile in np.unique(tiles[part]))


def plane_errors(uv: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """Errors [2 n] in px of a rigid plane's flow at pixels uv [n, 2]: each half of the blocks by the other half."""
    centred = uv - uv.mean(axis=0)
    design = _plane_design(*(centred / max(float(np.abs(centred).max()), 1.0)).T)
    odd = (uv // BLOCK_PX).sum(axis=1) % 2 == 1
    error = np.zeros_like(flow)
    for half in (odd, ~odd):
        error[half] = flow[half] - design[half] @ _fitted(design[~half], flow[~half])
    return error.ravel()


def _plane_design(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Flow [n, 2, 8] of a rigid plane at pixels x, y by its parameters."""
    zero, one = np.zeros_like(x), np.ones_like(x)
    rows_u = np.stack([one, x, y, zero, zero, zero, x * x, x * y], axis=-1)
    rows_v = np.stack([zero, zero, zero, one, x, y, x * y, y * y], axis=-1)
    return np.stack([rows_u, rows_v], axis=1)


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


def _weigh_regions(regions: list[Region]) -> Bought:
    """What a rigid plane saves over a static scene, with its uncertainty over the frames."""
    groups = [np.full(len(region.plane), region.edge) for region in regions]
    parts = [region.static for region in regions], [region.plane for region in regions], groups
    return weigh(*(np.concatenate([np.zeros(0), *part]) for part in parts))


def _static_residual(seen: Observed, edge: int) -> np.ndarray:
    """Difference [h, w, 2] in px of the flow of an edge from that of a static scene."""
    return np.asarray(seen.at_once(edge) - static_motion(seen, *seen.edges[edge])[0])


def _spread_edges(seen: Observed, offset: int) -> np.ndarray:
    """At most SAMPLED_EDGES edges of this frame distance, spread over the clip."""
    rows = np.flatnonzero(np.abs(seen.offsets) == offset)
    return rows[np.unique(np.linspace(0, len(rows) - 1, min(SAMPLED_EDGES, len(rows))).astype(int))]


def _median(parts: list[np.ndarray]) -> float:
    """Median of all parts; 0 where there is nothing."""
    values = np.concatenate(parts) if parts else np.zeros(0)
    return float(np.median(values)) if len(values) else 0.0
