"""Superpixels of a clip, and what links them: shared borders within a frame, matches of the flow between frames."""

from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import cv2
import numpy as np
from scipy import sparse

from stages.shared.artifacts import Dense
from stages.shared.images import relative_size
from stages.shared.log import progress
from stages.shared.threads import threaded

SIZE_PX = 8.0
"""Size of a superpixel, each way, in frames of REFERENCE_PX: small against movers, large against noise."""
MIN_SIZE_PX = 4
RULER = 15.0
ITERATIONS = 5
MIN_SIZE_PERCENT = 25
LINKED_OFFSETS = (1, 2, 3)
"""Frame distances of links. Longer ones add time and join what only looks matched."""
SAMPLED_PX = 2
"""Every other pixel each way is enough to count matches."""
MIN_CONFIDENCE = 0.05
AT_ONCE = 64
"""Frames, and edges, that are worked on before the memory of what was read for them is given back."""


class Superpixels(NamedTuple):
    """Superpixels of T frames, numbered through the clip.

    Attributes:
        labels: [T, h, w] uint16, the superpixel of every pixel, counted from 0 in each frame.
        first: [T + 1] int64; those of frame k are first[k]..first[k + 1].
        areas: [N] pixels; colours: [N, 3] mean CIELAB, 0..255.
    """

    labels: np.ndarray
    first: np.ndarray
    areas: np.ndarray
    colours: np.ndarray

    def part(self, start: int, stop: int) -> "Superpixels":
        """Those of the frames start..stop, numbered anew."""
        nodes = slice(self.first[start], self.first[stop])
        first = self.first[start : stop + 1] - self.first[start]
        return Superpixels(self.labels[start:stop], first, self.areas[nodes], self.colours[nodes])

    def means(self, images: Iterable[np.ndarray]) -> np.ndarray:
        """Means [N] over the superpixels of T images [h, w]."""
        counts = np.diff(self.first)
        sums = [
            np.bincount(labels.ravel(), image.ravel(), count)
            for labels, image, count in zip(self.labels, images, counts, strict=True)
        ]
        return np.asarray(np.concatenate(sums) / self.areas)

    def paint(self, values: np.ndarray, frame: int) -> np.ndarray:
        """Values [N] of the superpixels as an image [h, w] of one frame."""
        return np.asarray(values[self.first[frame] : self.first[frame + 1]][self.labels[frame]])


def superpixels(T: int, picture: Callable[[int], np.ndarray]) -> Superpixels:
    """The superpixels of T frames by SLIC (Achanta et al., TPAMI 2012).

    Args:
        picture: gives frame k [h, w, 3] uint8, and is called on several threads; frames are not kept.
    """
    found = []
    for start in progress(range(0, T, AT_ONCE), "superpixels"):
        found += threaded(lambda k: _of_frame(picture(k)), range(start, min(start + AT_ONCE, T)))
    labels, counts, colours = zip(*found, strict=True)
    areas = [np.bincount(of_frame.ravel(), minlength=n) for of_frame, n in zip(labels, counts, strict=True)]
    first = np.concatenate([[0], np.cumsum(counts)])
    return Superpixels(np.stack(labels), first, np.concatenate(areas).astype(float), np.concatenate(colours))


def _of_frame(rgb: np.ndarray) -> tuple[np.ndarray, int, np.ndarray]:
    """Labels [h, w], their number n, and mean colours [n, 3] of a frame."""
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB)
    size_px = max(MIN_SIZE_PX, round(SIZE_PX * relative_size(rgb)))
    if min(lab.shape[:2]) < size_px:  # OpenCV crashes on less than half of one
        return np.zeros(lab.shape[:2], np.uint16), 1, lab.reshape(1, -1, 3).mean(axis=1)
    slic = cv2.ximgproc.createSuperpixelSLIC(lab, cv2.ximgproc.SLIC, size_px, RULER)
    slic.iterate(ITERATIONS)
    slic.enforceLabelConnectivity(MIN_SIZE_PERCENT)
    labels = slic.getLabels()
    count = int(labels.max()) + 1  # OpenCV's own count may be one short
    areas = np.bincount(labels.ravel(), minlength=count)
    colours = [np.bincount(labels.ravel(), lab[..., c].ravel(), count) / areas for c in range(3)]
    return labels.astype(np.uint16), count, np.stack(colours, axis=1)


def borders(pixels: Superpixels) -> sparse.csr_matrix:
    """Length in pixels of the border that two superpixels of a frame share, [N, N], symmetric."""
    parts = []
    for k, labels in enumerate(pixels.labels):
        own = pixels.first[k : k + 2]
        for a, b in ((labels[:, :-1], labels[:, 1:]), (labels[:-1], labels[1:])):
            apart = a != b
            parts.append(_links(np.ones(apart.sum()), a[apart], b[apart], own, own))
    return _symmetric(parts, pixels.first[-1])


def matches(pixels: Superpixels, pairs: Mapping[str, np.ndarray], start: int = 0) -> sparse.csr_matrix:
    """Pixels that the flow matches between two superpixels of near frames, weighted by confidence, [N, N], symmetric.

    Args:
        pixels: of the frames from `start` on.
        pairs: source, target [E], flow [E, h, w, 2] px, confidence [E, h, w] of the whole clip.
    """
    T, h, w = pixels.labels.shape
    o, begin, end = SAMPLED_PX // 2, pairs["source"] - start, pairs["target"] - start
    linked = np.isin(np.abs(begin - end), LINKED_OFFSETS) & (np.minimum(begin, end) >= 0) & (np.maximum(begin, end) < T)
    v, u = np.mgrid[o:h:SAMPLED_PX, o:w:SAMPLED_PX]
    parts = []
    for n, e in enumerate(np.flatnonzero(linked)):
        i, j = begin[e], end[e]
        if n % AT_ONCE == 0 and isinstance(pairs, Dense):
            pairs.release()
        flow = pairs["flow"][e, o::SAMPLED_PX, o::SAMPLED_PX].astype(np.float32)
        confidence = pairs["confidence"][e, o::SAMPLED_PX, o::SAMPLED_PX].astype(np.float32)
        x, y = np.rint(u + flow[..., 0]).astype(int), np.rint(v + flow[..., 1]).astype(int)
        seen = (confidence > MIN_CONFIDENCE) & (x >= 0) & (x < w) & (y >= 0) & (y < h)
        rows, columns = pixels.labels[i][v[seen], u[seen]], pixels.labels[j][y[seen], x[seen]]
        of_frames = (pixels.first[k : k + 2] for k in (i, j))
        parts.append(_links(SAMPLED_PX**2 * confidence[seen], rows, columns, *of_frames))
    return _symmetric(parts, pixels.first[-1])


def _links(
    weights: np.ndarray, rows: np.ndarray, columns: np.ndarray, of_rows: np.ndarray, of_columns: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The summed weight of each two superpixels of two frames that are linked, and their numbers in the clip.

    Pixels become superpixels frame by frame: all at once would take ten times the memory.

    Args:
        weights: [L] of single pixels, whose superpixels are rows and columns [L] of their frames.
        of_rows, of_columns: [2] first and last + 1 of the superpixels of both frames.
    """
    shape = of_rows[1] - of_rows[0], of_columns[1] - of_columns[0]
    links = sparse.csr_matrix((weights, (rows, columns)), shape).tocoo()  # CSR sums duplicates, without a sort of all
    return links.data, of_rows[0] + links.row, of_columns[0] + links.col


def _symmetric(parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]], N: int) -> sparse.csr_matrix:
    """The sparse sum of links (weights, rows, columns) and of their transpose, [N, N]."""
    parts = [(np.zeros(0), *np.zeros((2, 0), int)), *parts]  # a clip of one frame has no matches
    data, row, column = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    total = sparse.coo_matrix((data, (row, column)), (N, N)).tocsr()
    return total + total.T
