"""Flow between frames that see a place again, searched from their matches."""

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.interpolate import RBFInterpolator

from stages.flow.dis import solve_pair
from stages.flow.edges import Edge
from stages.flow.frames import Images
from stages.flow.loops import Loop
from stages.shared.threads import threaded

NEAREST, STRIDE_PX = 16, 8
"""Matches that the flow between them follows, and the pixels between points at which it is interpolated."""


def loop_flow(grey: Images | np.ndarray, loops: Sequence[Loop], finest_scale: int) -> dict[Edge, np.ndarray]:
    """Flow [h, w, 2] px of both edges of every loop, searched from its matches.

    Args:
        grey: [T, h, w] uint8. finest_scale: as in `solve_pair`.
    """

    def both(loop: Loop) -> dict[Edge, np.ndarray]:
        (i, j), matches = loop
        starts = (between(of, grey[i].shape) for of in (matches, matches[:, ::-1]))
        pairs = zip(((i, j), (j, i)), starts, strict=True)
        return {(a, b): solve_pair(grey[a], grey[b], start, finest_scale) for (a, b), start in pairs}

    return {edge: of for found in threaded(both, loops) for edge, of in found.items()}


def between(matches: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """Flow [h, w, 2] px, float32, that is smooth between matches [n, 2, 2] px and within their range beyond them.

    Not by the interpolator of `matches.restarted`, which is given 250 matches and more: from the 39 to 92 of loops of a
    long walk it raised an error of its own bounds, and the search that it started crashed in some runs.

    Args:
        size: (height, width) of the frame.
    """
    here, flow = matches[:, 0].astype(float), (matches[:, 1] - matches[:, 0]).astype(float)
    spline = RBFInterpolator(here, flow, neighbors=min(len(here), NEAREST), smoothing=1.0, kernel="linear")
    coarse = [-(-side // STRIDE_PX) for side in size]
    at = STRIDE_PX * np.indices(coarse[::-1]).reshape(2, -1).T + (STRIDE_PX - 1) / 2  # (u, v), middles of cells
    found = spline(at).reshape(*coarse[::-1], 2).swapaxes(0, 1).clip(flow.min(axis=0), flow.max(axis=0))
    enlarged = cv2.resize(found, None, fx=STRIDE_PX, fy=STRIDE_PX, interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(enlarged[: size[0], : size[1]], np.float32)
