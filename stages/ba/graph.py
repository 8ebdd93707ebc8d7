"""Edges and observations of bundle adjustment, sampled from dense flow on a coarse grid of pixels."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from stages.shared.cameras import frame_from_grid, grid_from_frame, pixel_grid
from stages.shared.finite import require_finite
from stages.shared.flow_pairs import REACH
from stages.shared.images import reduce
from stages.shared.warp import bilinear

MIN_STATIC_SHARE = 0.15
"""Masks that leave a smaller static share of a frame than this are ignored."""

MIN_WEIGHT = 0.3
SURE_WEIGHT = 0.5
"""Weight above which a match is sure: the weight of flow without texture stays below one half."""
EDGES = 64
"""Edges whose dense flow is held at the same time."""
MIN_MATCHES = 50
"""Smallest number of confident matches that link two frames."""


@dataclass(frozen=True)
class FlowGraph:
    """Directed edges between frames, each with a match for every sampled pixel. Pixels are those of the flow grid.

    One focal length then serves both axes: where that of the y axis is `aspect` times that of the x axis, the v of
    pixels, matches and centre is divided by it. `on_grid` leads back.

    Attributes:
        source, target: [E] frame indices, sorted by source, then target.
        pointer: [T + 1], edges pointer[i]..pointer[i + 1] leave frame i.
        pixels: [P, 2] float64, row by row of the sampled grid of `rows` x `columns` cells of `stride` px.
        matches: [E, P, 2] float32, where the flow takes each pixel.
        weights: [E, P] float32 in 0..1.
        centre: principal point [2].
        width, height: of the flow grid.
        texture: [T, P] in 0..1, see `stages.ba.texture`; None: equal weights.
        aspect: fy / fx of the flow grid.
        times_s: [T] of the frames; None: evenly spaced.
        masked: whether what moves is taken to be left out: else a match may well lead beyond infinity.
        border_px: width of the border of the flow grid where the flow is biased outwards; 0 where it is not.
    """

    source: np.ndarray
    target: np.ndarray
    pointer: np.ndarray
    pixels: np.ndarray
    matches: np.ndarray
    weights: np.ndarray
    centre: np.ndarray
    width: int
    height: int
    stride: int
    texture: np.ndarray | None = None
    aspect: float = 1.0
    times_s: np.ndarray | None = None
    masked: bool = False
    border_px: float = 0.0

    @property
    def T(self) -> int:
        """Number of frames."""
        return len(self.pointer) - 1

    @property
    def long_side_px(self) -> float:
        """Longer side of the flow grid: the lens of a phone has one angle along it, however the phone is held."""
        return float(max(self.width, self.height))

    @property
    def corner_px(self) -> float:
        """Distance of a corner of the flow grid from its middle."""
        return float(np.hypot(self.width, self.height)) / 2

    @property
    def rows(self) -> int:
        """Sampled rows."""
        return self.height // self.stride

    @property
    def columns(self) -> int:
        """Sampled columns."""
        return self.width // self.stride

    def edge(self, i: int, j: int) -> int | None:
        """Index of the edge from frame i to frame j."""
        at = int(self.pointer[i] + np.searchsorted(self.target[self.pointer[i] : self.pointer[i + 1]], j))
        return at if at < self.pointer[i + 1] and self.target[at] == j else None

    def observed_frames(self) -> np.ndarray:
        """Which frames [T] have at least MIN_MATCHES sure matches."""
        shared = shared_matches(self.source, self.target, self.weights, self.T)
        return np.asarray(shared.sum(axis=1) >= MIN_MATCHES)

    def resample(self, maps: np.ndarray, stride: int) -> np.ndarray:
        """Maps [T, h, w] with one value per cell of `stride` px of the flow grid, sampled at the pixels, [T, P].

        Linear between the centres of the cells, constant beyond the outermost ones.
        """
        cells = grid_from_frame(self.on_grid(self.pixels), stride)
        return np.stack([bilinear(frame, cells) for frame in maps]).astype(float)

    def on_grid(self, uv: np.ndarray) -> np.ndarray:
        """Where pixels or matches [..., 2] of the graph lie on the flow grid."""
        return uv * np.array([1, self.aspect], uv.dtype)

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Values [T, rows, columns] of cells on the flow grid [T, height, width]; its border repeats the last cell."""
        v = np.minimum(np.arange(self.height) // self.stride, self.rows - 1)
        u = np.minimum(np.arange(self.width) // self.stride, self.columns - 1)
        return np.asarray(values[:, v[:, None], u])


def shared_matches(source: np.ndarray, target: np.ndarray, weights: np.ndarray, T: int) -> np.ndarray:
    """Number [T, T] of sure matches of each pair of frames, both directions together, of edges with weights [E, P]."""
    counts = np.zeros((T, T), np.int64)
    np.add.at(counts, (source, target), (weights > SURE_WEIGHT).sum(axis=1))
    return counts + counts.T


def build_graph(
    source: np.ndarray,
    target: np.ndarray,
    flow: np.ndarray,
    confidence: np.ndarray,
    T: int,
    stride: int,
    principal_point: np.ndarray | None = None,
    aspect: float = 1.0,
    release: Callable[[], None] = lambda: None,
    first: int = 0,
    border_px: float = 0.0,
) -> FlowGraph:
    """Sample flow [E, h, w, 2] px and confidence [E, h, w] at the centres of cells of `stride` px.

    The edges are those from row `first` on, as many as there are sources: they are read one by one.

    The centre of an even cell lies between four pixels: their mean is taken. Without a principal point [2] of the flow
    grid the centre of the image is used. `aspect` is fy / fx of the flow grid. `release` is called after every EDGES
    edges: it gives back what was read of a mapped file. `border_px` is as of `FlowGraph`.
    """
    source, target = np.ascontiguousarray(source), np.ascontiguousarray(target)
    h, w = flow.shape[1:3]
    rows, columns = h // stride, w // stride
    pixels = frame_from_grid(pixel_grid(rows, columns), stride).reshape(-1, 2)
    matches = np.empty((len(source), rows * columns, 2), np.float32)
    weights = np.empty((len(source), rows * columns), np.float32)
    for e in range(len(source)):
        matches[e] = sample_cells(flow[first + e], stride).reshape(-1, 2)
        weights[e] = sample_cells(confidence[first + e][..., None], stride).ravel()
        if (e + 1) % EDGES == 0:
            release()
    require_finite(flow=matches, confidence=weights)
    matches += pixels.astype(np.float32)
    pointer = np.searchsorted(source, np.arange(T + 1))
    middle = np.array([(w - 1) / 2, (h - 1) / 2]) if principal_point is None else principal_point
    square = np.array([1, 1 / aspect])
    matches *= square.astype(np.float32)
    pixels, middle = pixels * square, middle * square
    sampled = source, target, pointer, pixels, matches, weights
    return FlowGraph(*sampled, middle, w, h, stride, aspect=aspect, border_px=border_px)


def thin_graph(graph: FlowGraph, factor: int) -> FlowGraph:
    """Every `factor`-th row and column of the observations."""
    rows, columns = graph.rows // factor, graph.columns // factor
    index = np.arange(graph.rows * graph.columns).reshape(graph.rows, graph.columns)
    first = factor // 2
    chosen = index[first::factor, first::factor][:rows, :columns].ravel()
    # Unlike an index, `take` returns contiguous arrays: kernels compile for one memory layout and read it in order.
    pixels, matches, weights = graph.pixels[chosen], graph.matches.take(chosen, 1), graph.weights.take(chosen, 1)
    texture = None if graph.texture is None else graph.texture.take(chosen, 1)
    stride = graph.stride * factor
    return replace(graph, pixels=pixels, matches=matches, weights=weights, stride=stride, texture=texture)


def thinning(graph: FlowGraph, pixels: int) -> int:
    """The factor for `thin_graph` that leaves about so many pixels per frame."""
    return max(1, int(np.sqrt(len(graph.pixels) / pixels)))


def with_edges(graph: FlowGraph, kept: np.ndarray) -> FlowGraph:
    """The graph of some of its edges, [E] bool."""
    source, arrays = graph.source[kept], {name: getattr(graph, name)[kept] for name in ("target", "matches", "weights")}
    return replace(graph, source=source, pointer=np.searchsorted(source, np.arange(graph.T + 1)), **arrays)


def without_loops(graph: FlowGraph) -> FlowGraph:
    """The graph without edges over more than REACH frames; the same object if it has none."""
    near = np.abs(graph.target - graph.source) <= REACH
    return graph if near.all() else with_edges(graph, near)


def cut_out(graph: FlowGraph, inside: slice) -> FlowGraph:
    """The graph of the frames `inside` alone."""
    first, stop = inside.start, inside.stop
    kept = (graph.source >= first) & (graph.source < stop) & (graph.target >= first) & (graph.target < stop)
    part = with_edges(graph, kept)
    return replace(
        part,
        source=part.source - first,
        target=part.target - first,
        pointer=part.pointer[first : stop + 1],
        texture=None if graph.texture is None else graph.texture[inside],
        times_s=None if graph.times_s is None else graph.times_s[inside],
    )


def static_areas(masks: Iterable[np.ndarray], width: int, height: int, margin_px: int = 2) -> np.ndarray:
    """Static area [T, height, width] int8 (0: dynamic) on the flow grid of T masks [H, W], which grow by a margin."""
    kernel = np.ones((2 * margin_px + 1, 2 * margin_px + 1), np.uint8)
    small = (reduce(mask.astype(np.float32), (width, height)) for mask in masks)
    return np.stack([1 - cv2.dilate((frame > 0.25).astype(np.uint8), kernel) for frame in small]).view(np.int8)


def trusted_static_areas(static: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Static areas without the masks of almost wholly dynamic frames, and which frames [T] have their mask ignored."""
    dropped = static.mean(axis=(1, 2)) < MIN_STATIC_SHARE
    if dropped.any():
        static = static.copy()
        static[dropped] = 1
    return static, dropped


def sample_cells(image: np.ndarray, stride: int) -> np.ndarray:
    """Mean of the pixel or the pixels nearest to the centre of each cell: [h, w, c] to [rows, columns, c] float32."""
    h, w, c = image.shape
    rows, columns = h // stride, w // stride
    cells = image[: rows * stride, : columns * stride].reshape(rows, stride, columns, stride, c)
    low, high = (stride - 1) // 2, stride // 2 + 1
    middle = [cells[:, y, :, x] for y in range(low, high) for x in range(low, high)]
    return np.asarray(np.sum(middle, axis=0, dtype=np.float32) / len(middle))
