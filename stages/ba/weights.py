"""How much the observations of a graph count: by texture, distance, masks, and at the border of the image."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from stages.ba.graph import FlowGraph, sample_cells
from stages.shared.flow_pairs import REACH
from stages.shared.warp import bilinear

BORDER_WEIGHT = 0.1
"""Factor on the weight of pixels at the border of the image where cameras only turn. Where they travel, these pixels
count in full: on unseen clips paths without them are worse."""
BORDER_SHARE = 1 / 16
"""Largest width of this border, as a share of the shorter side."""


def with_texture(graph: FlowGraph, texture: Iterable[np.ndarray]) -> FlowGraph:
    """The graph with texture weights [height, width] in 0..1 of each of the T frames, sampled at its pixels."""
    sampled = [graph.resample(frame[None], 1)[0].astype(np.float32) for frame in texture]
    return replace(graph, texture=np.stack(sampled))


def favour_distance(graph: FlowGraph) -> FlowGraph:
    """The graph with weights multiplied by the frame distance, relative to its mean over the edges, and by texture.

    That of edges over more than REACH frames counts as REACH: their flow is as good as over a long edge, not better.
    """
    distance = np.minimum(np.abs(graph.target - graph.source), REACH).astype(np.float32)
    weights = graph.weights * (distance / distance.mean())[:, None]
    return replace(graph, weights=weights if graph.texture is None else weights * graph.texture[graph.source])


def downweight_border(graph: FlowGraph) -> FlowGraph:
    """The graph with little weight at its border: flow that leads outwards there makes the focal length too long."""
    border = min(graph.border_px, BORDER_SHARE * min(graph.width, graph.height))
    end = np.array([graph.width, graph.height]) - 1 - border
    on_grid = graph.on_grid(graph.pixels)
    inner = ((on_grid >= border) & (on_grid <= end)).all(axis=1)
    return replace(graph, weights=graph.weights * np.where(inner, 1, BORDER_WEIGHT).astype(np.float32))


def mask_graph(graph: FlowGraph, static: np.ndarray) -> FlowGraph:
    """Multiply the weights by how static [T, h, w] (0..1) the pixel is at both ends of its match.

    The graph is `masked` if anything is left out.
    """
    weights = graph.weights.copy()
    for i in np.unique(graph.source):
        here = sample_cells(static[i].astype(np.float32)[..., None], graph.stride).ravel()
        for e in range(graph.pointer[i], graph.pointer[i + 1]):
            there = static[graph.target[e]].astype(np.float32)
            weights[e] *= here * bilinear(there, graph.on_grid(graph.matches[e]))
    return replace(graph, weights=weights, masked=graph.masked or bool((static < 1).any()))
