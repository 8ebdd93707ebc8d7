"""Input of the evidence: the training frames on the flow grid, with static pixels, depth and cameras."""

from dataclasses import dataclass

import numpy as np

from stages.shared.artifacts import Dense
from stages.shared.cameras import grid_from_frame, pixel_grid, projection, static_flow
from stages.shared.frame_store import Computed, Frames
from stages.shared.warp import bilinear


@dataclass(frozen=True)
class Observed:
    """F training frames on the flow grid [h, w] and the E flow edges between them. Held-out frames are not in here.

    Colours, depth and flow are looked up frame by frame, and edge by edge: they need not be in memory.

    Attributes:
        rgb: F times [h, w, 3] float32 in 0..1. dynamic: [F, h, w] bool, the masks.
        instances: [F, h, w] what of them has one number through the clip; 0 where static.
        depth: F times [h, w] z-depth in scene units; in dynamic pixels a guess from their border.
        cam_from_world: [F, 4, 4]. Ks: [F, 3, 3] in pixels of the flow grid.
        edges: [E, 2] positions in 0..F-1, source and target. flow: E times [h, w, 2] px. confidence: E times [h, w],
            0..1.
        offsets: [E] frame distances of the edges, signed.
        scene: [h, w] bool, false where something is burnt into all frames; None: nothing is.
        unrolled: E times [h, w, 2] px, the flow without what a rolling shutter adds; None: it adds nothing.
    """

    rgb: Frames[np.ndarray]
    dynamic: np.ndarray
    instances: np.ndarray
    depth: Frames[np.ndarray]
    cam_from_world: np.ndarray
    Ks: np.ndarray
    edges: np.ndarray
    flow: Frames[np.ndarray]
    confidence: Frames[np.ndarray]
    offsets: np.ndarray
    scene: np.ndarray | None = None
    unrolled: Frames[np.ndarray] | None = None

    def at_once(self, edge: int) -> np.ndarray:
        """Flow [h, w, 2] of an edge as if all rows were exposed at once, which no picture shows."""
        return (self.flow if self.unrolled is None else self.unrolled)[edge]


def read_edges(pairs: Dense, column: str, rows: np.ndarray) -> Computed[np.ndarray]:
    """Float32 values of a column of flow/pairs.arrow at its `rows` [E], read when they are used, and given back."""

    def read(e: int) -> np.ndarray:
        values = np.asarray(pairs[column][rows[e]].astype(np.float32))
        pairs.release()
        return values

    return Computed(len(rows), read)


def depth_on_grid(inverse_depth: np.ndarray, stride_px: float, scale: float, height: int, width: int) -> np.ndarray:
    """z-depth [F, h, w] on the flow grid from the solver's inverse depth [F, h', w'] > 0, bilinear in its logarithm.

    Args:
        stride_px: full-frame pixels per pixel of the solver's grid, as in `frame_from_grid`.
        scale: width of the flow grid over that of the frame.
    """
    cells = grid_from_frame(pixel_grid(height, width), stride_px * scale)
    return np.exp(-np.stack([bilinear(log, cells) for log in np.log(inverse_depth)]))


def static_motion(seen: Observed, source: int, target: int) -> tuple[np.ndarray, np.ndarray]:
    """Flow [h, w, 2] from a frame to another if nothing moves, and the z-depth there over the one here [h, w]."""
    depth = seen.depth[source].astype(float)
    cameras = ((seen.cam_from_world[k], seen.Ks[k]) for k in (source, target))
    return static_flow(pixel_grid(*depth.shape), 1 / depth, *projection(*cameras))
