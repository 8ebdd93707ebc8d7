"""Dense flow between many pairs of frames by OpenCV's dense inverse search (Kroeger et al., ECCV 2016)."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import cv2
import numpy as np

from stages.shared.log import progress
from stages.shared.warp import warp

Edge = tuple[int, int]


def edge_list(T: int, offsets: Sequence[int]) -> list[Edge]:
    """Directed edges (i, j) of T frames with |i - j| in `offsets`, both ways, sorted."""
    return sorted((i, j) for i in range(T) for j in range(T) if abs(i - j) in offsets)


def estimate_flow(grey: np.ndarray, edges: Sequence[Edge], finest_scale: int, threads: int) -> dict[Edge, np.ndarray]:
    """Flow [h, w, 2] float32 px of every edge between frames grey [T, h, w] uint8.

    Short edges go first; a longer one starts from the chain of shorter ones that leads to its target, which keeps
    the search within reach of large motions. The result does not depend on `threads`.
    """
    flow: dict[Edge, np.ndarray] = {}
    levels = sorted({abs(i - j) for i, j in edges})
    with ThreadPoolExecutor(threads) as pool:
        for offset in progress(levels, "flow"):
            level = [edge for edge in edges if abs(edge[1] - edge[0]) == offset]
            starts = [chained(flow, edge) for edge in level]
            sources, targets = [grey[i] for i, _ in level], [grey[j] for _, j in level]
            solved = pool.map(_dis, sources, targets, starts, [finest_scale] * len(level))
            flow |= dict(zip(level, solved, strict=True))
    return flow


def chained(flow: dict[Edge, np.ndarray], edge: Edge) -> np.ndarray | None:
    """Flow of `edge` composed of known ones, longest steps first; None where they do not reach the target."""
    i, j = edge
    sign = 1 if j > i else -1
    steps = sorted({abs(b - a) for a, b in flow}, reverse=True)
    stops = [i]
    while stops[-1] != j:
        step = next((offset for offset in steps if offset <= abs(j - stops[-1])), None)
        if step is None:
            return None
        stops.append(stops[-1] + sign * step)
    total, *rest = [flow[hop] for hop in pairwise(stops)]
    for hop in rest:
        total = total + warp(hop, total)
    return total


def _dis(source: np.ndarray, target: np.ndarray, start: np.ndarray | None, finest_scale: int) -> np.ndarray:
    """One pair. The solver object holds buffers that threads must not share, so every call makes its own."""
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    dis.setFinestScale(finest_scale)
    dis.setPatchStride(4)
    dis.setVariationalRefinementIterations(10)
    return np.asarray(dis.calc(source, target, start))
