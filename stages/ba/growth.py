"""How the parts of the image that move grow over time: what comes nearer grows as its inverse depth does."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from stages.ba.graph import EDGES, MIN_WEIGHT, FlowGraph

FEWEST, LEAST_SHARE = 8, 0.1
"""Shared pixels of two regions from which on they are linked, and their share of the smaller region."""
ROBUST_PX, NOISE_PX = 0.5, 0.2
"""Scale of the robust kernel, and the least noise of a match: neighbours err alike."""
ITERATIONS = 8


class Links(NamedTuple):
    """Pairs of regions of two frames between which flow leads.

    Attributes:
        source, target: [n] numbers of the regions, from 1 on. gap: [n] frames between them.
        log_growth: [n] log of the size in the target over that in the source. sigma: [n] its standard deviation.
        pixels: [n] how many they share.
    """

    source: np.ndarray
    target: np.ndarray
    gap: np.ndarray
    log_growth: np.ndarray
    sigma: np.ndarray
    pixels: np.ndarray


def number_regions(dynamic: np.ndarray) -> np.ndarray:
    """Numbers [T, h, w] int32 of the connected regions of each frame, counted over all frames from 1 on; 0: static."""
    numbers, before = np.zeros(dynamic.shape, np.int32), 0
    for k, frame in enumerate(dynamic):
        count, regions = cv2.connectedComponents(frame.astype(np.uint8), connectivity=4)
        numbers[k] = np.where(regions > 0, regions + before, 0)
        before += count - 1
    return numbers


def link_regions(graph: FlowGraph, numbers: np.ndarray) -> Links:
    """Links of the regions `numbers` [T, rows, columns] along the edges of a graph, without masks, on their grid.

    The growth of a link is the scale of the similarity that maps the shared pixels of both: y = a x + t of complex
    numbers x, y, by iteratively reweighted least squares. Where several regions of a frame lead to one of another,
    things meet, and none is linked: their depths differ.
    """
    area = np.bincount(numbers.ravel())
    blocks = (np.arange(first, first + EDGES) for first in range(0, len(graph.source), EDGES))
    return join_links([_linked(graph, numbers, area, block[block < len(graph.source)]) for block in blocks])


def join_links(parts: Sequence[Links]) -> Links:
    """The links of several blocks of edges."""
    none, nothing = np.zeros(0, int), np.zeros(0)
    empty = Links(none, none, none, nothing, nothing, none)
    return Links(*(np.concatenate(columns) for columns in zip(empty, *parts, strict=True)))


def _linked(graph: FlowGraph, numbers: np.ndarray, area: np.ndarray, edges: np.ndarray) -> Links:
    """The links along some edges of regions of so many cells each, `area`."""
    flat = numbers.reshape(graph.T, -1)
    edge, pixel = np.nonzero((flat[graph.source[edges]] > 0) & (graph.weights[edges] > MIN_WEIGHT))
    edge = edges[edge]
    ends = graph.matches[edge, pixel]
    u, v = np.rint((graph.on_grid(ends) - (graph.stride - 1) / 2) / graph.stride).astype(int).T
    inside = (u >= 0) & (v >= 0) & (u < graph.columns) & (v < graph.rows)
    edge, pixel, ends, u, v = (values[inside] for values in (edge, pixel, ends, u, v))
    at_source, at_target = flat[graph.source[edge], pixel].astype(np.int64), numbers[graph.target[edge], v, u]
    moved = at_target > 0
    edge, pixel, ends = edge[moved], pixel[moved], ends[moved]
    key, group, pixels = np.unique((at_source * len(area) + at_target)[moved], return_inverse=True, return_counts=True)
    source, target = np.divmod(key, len(area))
    x, y = (uv[:, 0].astype(float) + 1j * uv[:, 1] for uv in (graph.pixels[pixel], ends))
    log_growth, sigma = _scales(x, y, graph.weights[edge, pixel].astype(float), group, len(pixels))
    along = np.zeros(len(pixels), int)
    along[group] = edge
    kept = (pixels >= FEWEST) & (pixels >= LEAST_SHARE * np.minimum(area[source], area[target]))
    kept[kept] = _alone(source[kept], along[kept]) & _alone(target[kept], along[kept])
    gap = np.abs(graph.target - graph.source)[along]
    return Links(*(values[kept] for values in (source, target, gap, log_growth, sigma, pixels)))


def _alone(region: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """Which of several pairs [n] are the only one of their region along their edge."""
    _, at, count = np.unique(np.stack([edge, region]), axis=1, return_inverse=True, return_counts=True)
    return np.asarray(count[at.ravel()] == 1)


def _scales(
    x: np.ndarray, y: np.ndarray, weights: np.ndarray, group: np.ndarray, groups: int
) -> tuple[np.ndarray, np.ndarray]:
    """Log scale and its standard deviation [groups] of the similarities from x to y [n] complex, of each group [n]."""

    def sums(values: np.ndarray) -> np.ndarray:
        if np.iscomplexobj(values):
            return np.asarray(sums(values.real) + 1j * sums(values.imag))
        return np.bincount(group, values, groups)

    robust = weights
    for _ in range(ITERATIONS):
        total = np.maximum(sums(robust), 1e-12)
        from_x, from_y = x - (sums(robust * x) / total)[group], y - (sums(robust * y) / total)[group]
        spread = np.maximum(sums(robust * np.abs(from_x) ** 2), 1e-12)
        a = sums(robust * np.conj(from_x) * from_y) / spread
        errors_px = np.abs(from_y - a[group] * from_x)
        noise_px = np.sqrt(np.maximum(sums(robust * errors_px**2) / (2 * total), NOISE_PX**2))
        robust = weights / (1 + (errors_px / ROBUST_PX) ** 2)
    scale = np.maximum(np.abs(a), 1e-3)
    return np.log(scale), noise_px / (scale * np.sqrt(spread))
