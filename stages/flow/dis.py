"""Dense flow between pairs of frames by OpenCV's dense inverse search (Kroeger et al., ECCV 2016)."""

from collections import ChainMap
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import cast

import cv2
import numpy as np

from stages.flow.edges import Edge, path
from stages.flow.frames import Images
from stages.shared.warp import warp


def estimate_flow(
    grey: np.ndarray | Images,
    edges: Sequence[Edge],
    finest_scale: int,
    threads: int,
    known: Mapping[Edge, np.ndarray] | None = None,
) -> dict[Edge, np.ndarray]:
    """Flow [h, w, 2] float32 px of every edge between frames grey [T, h, w] uint8, an array or `Images`.

    Edges are solved by increasing length. A longer edge starts from the chained flow of shorter edges or of `known`
    ones, which brings large motions within the range of the search. The result does not depend on `threads`.

    Args:
        finest_scale: finest pyramid level searched; 0 is full size.
        known: flow [h, w, 2] px of edges that are not to be solved again.
    """
    flow: ChainMap[Edge, np.ndarray] = ChainMap({}, cast(dict[Edge, np.ndarray], known or {}))

    def solved(edge: Edge, distances: Sequence[int]) -> np.ndarray:
        start = chained(flow, path(flow, distances, edge))
        return solve_pair(grey[edge[0]], grey[edge[1]], start, finest_scale)

    with ThreadPoolExecutor(threads) as pool:
        for offset in sorted({abs(i - j) for i, j in edges}):
            level = [edge for edge in edges if abs(edge[1] - edge[0]) == offset]
            distances = sorted({abs(i - j) for i, j in flow}, reverse=True)
            found = list(pool.map(solved, level, [distances] * len(level)))
            flow.update(zip(level, found, strict=True))
    return {edge: flow[edge] for edge in edges}


def chained(flow: Mapping[Edge, np.ndarray], hops: Sequence[Edge] | None) -> np.ndarray | None:
    """Flow [h, w, 2] px from the first to the last frame of `hops`, composed of known flow; None without hops."""
    if not hops:
        return None
    total = flow[hops[0]]
    for hop in hops[1:]:
        total = total + warp(flow[hop], total)
    return total


def solve_pair(source: np.ndarray, target: np.ndarray, start: np.ndarray | None, finest_scale: int) -> np.ndarray:
    """Flow [h, w, 2] float32 px between two grey frames [h, w] uint8, searched from `start` [h, w, 2] (zero if None).

    Args:
        finest_scale: finest pyramid level searched; 0 is full size.
    """
    # The solver object holds buffers that threads must not share, so every call makes its own.
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    dis.setFinestScale(finest_scale)
    dis.setPatchStride(4)
    dis.setVariationalRefinementIterations(5)  # more take longer and do not improve the camera paths
    return np.asarray(dis.calc(source, target, start))
