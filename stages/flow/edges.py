"""Which pairs of frames are matched: near ones by their distance, far ones where enough of the view is shared."""

from collections.abc import Container, Iterable, Iterator, Mapping, Sequence

import numpy as np

from stages.shared.cameras import pixel_grid
from stages.shared.flow_pairs import REACH
from stages.shared.warp import bilinear

Edge = tuple[int, int]

LADDER = (8, 12, 16, 24, 32, 48, REACH)
"""Frame distances of long edges, up to REACH."""
MIN_COVISIBLE = 0.3
"""Least share of a frame's pixels that can be tracked to the target of a long edge."""
CONSISTENT_PX = 1.5
"""A track is lost where forward and backward flow of a step disagree by more than this."""
TRACK_STRIDE_PX = 8
LOOPS_PER_FRAME = 2
"""Loops (stages.flow.loops) that a frame may take part in."""


def edge_list(T: int, offsets: Sequence[int]) -> list[Edge]:
    """Directed edges (i, j) of T frames with |i - j| in `offsets`, both ways, sorted."""
    return sorted((i, j) for i in range(T) for j in range(T) if abs(i - j) in offsets)


def edges_ending(run: range, offsets: Sequence[int]) -> list[Edge]:
    """Directed edges (i, j) with |i - j| in `offsets`, both ways, whose later frame is one of `run`, sorted."""
    pairs = [(j - offset, j) for j in run for offset in offsets if j >= offset]
    return sorted({edge for i, j in pairs for edge in ((i, j), (j, i))})


def most_edges(T: int, offsets: Sequence[int], per_frame: int) -> int:
    """Largest possible number of directed edges of T frames: that of a sequence whose frames all share their view.

    Args:
        offsets: frame distances of near edges. per_frame: long edges per frame, at most.
    """
    near = {offset for offset in offsets if offset < T}
    rungs = [rung for rung in LADDER if rung > max(near, default=0)]
    short = sum(T - offset for offset in near)
    return 2 * (short + sum(min(per_frame, sum(i + rung < T for rung in rungs)) for i in range(T)))


def most_loops(T: int) -> int:
    """Largest possible number of directed edges that loops add to T frames."""
    return LOOPS_PER_FRAME * T if T > REACH + 1 else 0


def long_edges(
    flow: Mapping[Edge, np.ndarray], T: int, per_frame: int, sources: Iterable[int] | None = None
) -> list[Edge]:
    """Directed edges (i, j) longer than those of the known flow [h, w, 2] px, both ways, sorted.

    Each frame is connected to at most `per_frame` later ones: those at the largest distances in LADDER to which enough
    pixels can be tracked along the flow. The number of edges and the cost of choosing them are linear in T.

    Args:
        sources: earlier frames of the edges, of which flow is known as far as the edges may reach; None: all.
    """
    distances = sorted({j - i for i, j in flow if j > i}, reverse=True)
    rungs = [rung for rung in LADDER if rung > max(distances, default=0)]
    chosen = []
    for i in (range(T) if sources is None else sources) if per_frame else ():
        seen = list(_covisible(flow, i, distances, rungs))[-per_frame:]
        chosen += [edge for j in seen for edge in ((i, j), (j, i))]
    return sorted(chosen)


def path(known: Container[Edge], distances: Sequence[int], edge: Edge) -> list[Edge] | None:
    """Known edges that lead from one end of `edge` to the other, longest first; None if there is no such chain.

    Args:
        distances: frame distances of known edges, in descending order.
    """
    at, j = edge
    sign = 1 if j > at else -1
    hops = []
    while at != j:
        steps = (at + sign * d for d in distances if d <= abs(j - at))
        nearer = next((k for k in steps if (at, k) in known), None)
        if nearer is None:
            return None
        hops.append((at, nearer))
        at = nearer
    return hops


def _covisible(
    flow: Mapping[Edge, np.ndarray], i: int, distances: Sequence[int], rungs: Sequence[int]
) -> Iterator[int]:
    """Frames at the distances `rungs` from frame i, as long as enough pixels of frame i can be tracked there."""
    points, at = None, i
    for rung in rungs:
        hops = path(flow, distances, (at, i + rung))
        if hops is None:
            return
        if points is None:
            points = track_points(*flow[hops[0]].shape[:2])
            enough = MIN_COVISIBLE * len(points)
        for hop in hops:
            moved, kept = tracked(points, flow[hop], flow[hop[::-1]])
            points = moved[kept]
        if len(points) < enough:
            return
        at = i + rung
        yield at


def track_points(h: int, w: int) -> np.ndarray:
    """Every TRACK_STRIDE_PX-th pixel (u, v), [n, 2] float32."""
    return pixel_grid(h, w)[::TRACK_STRIDE_PX, ::TRACK_STRIDE_PX].reshape(-1, 2).astype(np.float32)


def tracked(points: np.ndarray, forward: np.ndarray, backward: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points [n, 2] px moved along one edge, and which of them [n] stay in it and pass the forward-backward check."""
    h, w = forward.shape[:2]
    moved = points + bilinear(forward, points)
    inside = ((moved >= 0) & (moved <= (w - 1, h - 1))).all(axis=1)
    found_back = np.linalg.norm(moved + bilinear(backward, moved) - points, axis=1) < CONSISTENT_PX
    return moved, inside & found_back
