"""Where the unknowns of a long sequence stand: along a band of the frames, or in a border of what they share."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from stages.ba.graph import FlowGraph


@dataclass(frozen=True)
class Layout:
    """Where the unknowns stand.

    Attributes:
        place: [n] of every unknown among the free ones: along the band, then in the border; -1: it is not free.
        frame: [band] frame of each unknown along the band; width: largest distance of two that are linked.
        band, border: their numbers.
    """

    place: np.ndarray
    frame: np.ndarray
    width: int
    band: int
    border: int


def layout(graph: FlowGraph, size: int, free: np.ndarray, zoom: bool) -> Layout:
    """The layout of `size` unknowns, of which `free` are solved for; with `zoom` every frame has a focal length.

    The frames keep their order where this makes the band no wider.
    """
    T = graph.T
    links = _links(graph, zoom)
    folded = reverse_cuthill_mckee(links, symmetric_mode=True)
    of_frame = [6 * np.arange(T)[:, None] + np.arange(6)] + ([6 * T + np.arange(T)[:, None]] if zoom else [])
    unknowns = np.concatenate(of_frame, axis=1)
    is_free = np.zeros(size, bool)
    is_free[free] = True
    found = []
    for order in (np.arange(T), folded):
        along = unknowns[order].ravel()
        along = along[is_free[along]]
        place = np.full(size, -1)
        place[along] = np.arange(len(along))
        found.append((_width(links, place[unknowns], len(along)), along, place))
    width, along, place = min(found, key=lambda candidate: candidate[0])
    shared = np.setdiff1d(free, along)
    place[shared] = len(along) + np.arange(len(shared))
    frame = np.where(along < 6 * T, along // 6, along - 6 * T)
    return Layout(place, frame, width, len(along), len(shared))


def _links(graph: FlowGraph, zoom: bool) -> csr_matrix:
    """Which frames [T, T] are linked: those that a frame has edges to, to each other and to it."""
    T = graph.T
    own = np.arange(T)
    row, column = np.append(graph.source, own), np.append(graph.target, own)
    if zoom:  # the prior on the curve of the focal lengths links three frames that follow each other
        row, column = np.append(row, [own[1:-1]] * 2), np.append(column, [own[:-2], own[2:]])
    seen = csr_matrix((np.ones(len(row)), (row, column)), shape=(T, T))
    return csr_matrix(seen.T @ seen)


def _width(links: csr_matrix, places: np.ndarray, band: int) -> int:
    """Largest distance along the band of two unknowns of linked frames, whose places are [T, n], -1: not free."""
    first, last = np.where(places >= 0, places, band).min(axis=1), places.max(axis=1)
    pairs = links.tocoo()
    reach = (last[pairs.row] - first[pairs.col])[(last[pairs.row] >= 0) & (last[pairs.col] >= 0)]
    return int(reach.max(initial=0))
