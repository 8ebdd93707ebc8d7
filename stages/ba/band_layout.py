"""Where the unknowns of a long sequence stand: along a band of the frames, or in a border beside it."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from stages.ba.graph import FlowGraph
from stages.shared.flow_pairs import REACH


@dataclass(frozen=True)
class Layout:
    """Where the unknowns stand.

    Attributes:
        place: [n] of every unknown among the free ones: along the band, then in the border; -1: it is not free.
        frame: [band] frame of each unknown along the band; width: largest distance of two that are linked.
        first: [border] place of the first unknown along the band that each is linked to, ascending.
    """

    place: np.ndarray
    frame: np.ndarray
    width: int
    first: np.ndarray

    @property
    def band(self) -> int:
        """Number of unknowns along the band."""
        return len(self.frame)

    @property
    def border(self) -> int:
        """Number of unknowns in the border."""
        return len(self.first)

    @property
    def work(self) -> float:
        """Multiplications of a factorisation: of the band, of the border with it, and of the border."""
        along = self.width**2 + 2 * self.width * self.border + self.border**2
        return float(self.band) * along + self.border**3 / 3


def layout(graph: FlowGraph, size: int, free: np.ndarray, zoom: bool) -> Layout:
    """The layout of `size` unknowns, of which `free` are solved for; with `zoom` every frame has a focal length.

    What all frames share stands in the border. The frames keep their order, or are folded where loops join them, or
    keep their order but for the ends of loops, which stand in the border: whatever takes least work. Where every frame
    is such an end, nothing would be left along the band.
    """
    T, links = graph.T, _links(graph, zoom)
    of_frame = [6 * np.arange(T)[:, None] + np.arange(6)] + ([6 * T + np.arange(T)[:, None]] if zoom else [])
    unknowns = np.concatenate(of_frame, axis=1)
    is_free = np.zeros(size, bool)
    is_free[free] = True
    ends = np.unique(graph.source[np.abs(graph.target - graph.source) > REACH])
    folded = reverse_cuthill_mckee(links, symmetric_mode=True)
    orders = [np.arange(T), folded] + ([np.setdiff1d(np.arange(T), ends)] if len(ends) else [])
    found = [_placed(links, unknowns, is_free, order) for order in orders]
    return min((at for at in found if at.band), key=lambda at: at.work)


def _placed(links: csr_matrix, unknowns: np.ndarray, is_free: np.ndarray, order: np.ndarray) -> Layout:
    """The layout with the frames of `order` along the band, and the others in the border.

    Args:
        unknowns: [T, n] of every frame.
    """
    T, place = len(unknowns), np.full(len(is_free), -1)
    along = unknowns[order].ravel()
    along = along[is_free[along]]
    place[along] = np.arange(len(along))
    places = place[unknowns]
    apart = np.setdiff1d(np.arange(T), order)
    first = np.where(places >= 0, places, len(along)).min(axis=1)
    reached = np.array([first[links[frame].indices].min() for frame in apart], int)
    by_reach = np.argsort(reached, kind="stable")
    beside = unknowns[apart[by_reach]]
    kept = is_free[beside]
    shared = np.setdiff1d(np.flatnonzero(is_free), unknowns)
    border = np.concatenate([shared, beside[kept]])
    place[border] = len(along) + np.arange(len(border))
    frame = np.where(along < 6 * T, along // 6, along - 6 * T)
    starts = np.concatenate([np.zeros(len(shared), int), np.repeat(reached[by_reach], kept.sum(axis=1))])
    return Layout(place, frame, _width(links, places, len(along)), starts)


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
    """Largest distance along the band of two unknowns of linked frames, whose places are [T, n], -1: not along it."""
    first, last = np.where(places >= 0, places, band).min(axis=1), places.max(axis=1)
    pairs = links.tocoo()
    reach = (last[pairs.row] - first[pairs.col])[(last[pairs.row] >= 0) & (last[pairs.col] >= 0)]
    return int(reach.max(initial=1))
