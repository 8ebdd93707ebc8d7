"""The passes over a clip: near edges first, and behind them, where a long edge may reach, the far ones.

At any time the flow of a window of frames is at hand; it does not grow with the clip. The results are those of matching
all edges of a clip by increasing length: an edge is searched from flow between its two frames alone.
"""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Protocol

import numpy as np
import pyarrow as pa

from stages.flow.edges import LADDER, Edge, edges_ending, long_edges, most_loops
from stages.flow.frames import blocks
from stages.flow.options import FlowOptions
from stages.flow.parts import Parts, Window
from stages.shared.masks import within
from stages.shared.packing import Packed, pack
from stages.shared.threads import threaded

if TYPE_CHECKING:
    from stages.flow.estimate import Estimate

Flows = dict[Edge, np.ndarray]


class Matcher(Protocol):
    """What finds the flow between frames.

    Attributes:
        others: edges that are matched besides those of the options.
    """

    others: frozenset[Edge]

    def near(self, edges: list[Edge], near: Mapping[Edge, np.ndarray], /) -> tuple[Flows, int]:
        """Flow [h, w, 2] px of near edges, with that of shorter ones at hand; how many were searched from matches."""

    def far(self, edges: list[Edge], near: Mapping[Edge, np.ndarray], far: Mapping[Edge, np.ndarray], /) -> Flows:
        """Flow [h, w, 2] px of far edges, with that of near and of shorter far ones at hand."""

    def confidence(self, edge: Edge, flow: Flows, /) -> np.ndarray:
        """Confidence [h, w] in 0..1 of an edge; the flow of its reverse is there too."""


def match(matcher: Matcher, T: int, options: FlowOptions, parts: Parts, scene: np.ndarray | None) -> Iterator[int]:
    """Match T frames and keep the results in `parts`; yields the number of edges of every block that is done.

    Args:
        scene: [h, w] bool, false where something is burnt into the frames; None: nowhere.
    """
    near, far = parts.windows["near"], parts.windows["far"]
    reach = max([*LADDER, *(abs(j - i) for i, j in matcher.others)])
    far_ends = _FarEnds(near, T, options, matcher.others)
    for kind, run in _steps(T, reach):
        done = parts.resume(kind, run)
        if done is None:
            started = 0
            if kind == "near":
                flow, started = matcher.near(edges_ending(run, options.offsets), near)
            else:
                flow = matcher.far(far_ends.ending(run, reach), near, far)
            packed, sure = _packed(matcher, flow, scene)
            far_ones = sum(j - i > max(options.offsets) for i, j in flow)
            parts.add(kind, run, flow, packed, started_from_matches=started, long_edges=far_ones, confident=sure)
            done = len(flow)
        if kind == "far":
            for window in (near, far):
                window.drop(run.stop - reach)
        for window in (near, far):
            window.release()
        yield done


def close_loops(estimate: "Estimate", T: int, parts: Parts, scene: np.ndarray | None) -> dict[str, int]:
    """Match frames that show a place again, once all near flow is known; arguments as in `match`.

    Returns:
        facts: `loops`, pairs of frames, and `frames_in_loops`.
    """
    if not most_loops(T):
        return {"loops": 0, "frames_in_loops": 0}
    near = parts.kept("near")
    found = estimate.loops(near, scene)
    near.release()
    for run in blocks(len(found)):
        if parts.resume("loop", run) is None:
            flow = estimate.closed(found[run.start : run.stop])
            packed, sure = _packed(estimate, flow, scene)
            parts.add("loop", run, flow, packed, confident=sure)
    ends = [i for i, _ in parts.kept("loop")]
    return {"loops": len(ends) // 2, "frames_in_loops": len(set(ends))}


def _steps(T: int, reach: int) -> Iterator[tuple[str, range]]:
    """Blocks of near and of far edges: the latter when near flow is known as far as a long edge may reach."""
    waiting = blocks(T)
    for run in blocks(T):
        yield "near", run
        while waiting and min(waiting[0].stop + reach, T) <= run.stop:
            yield "far", waiting.pop(0)


class _FarEnds:
    """Which far edges end where. The frames to which an edge leads from frame i depend on all that can be tracked."""

    def __init__(self, near: Window, T: int, options: FlowOptions, others: frozenset[Edge]) -> None:
        self.near, self.T, self.per_frame, self.others = near, T, options.long_edges, others
        self.chosen: dict[int, list[Edge]] = {}

    def ending(self, run: range, reach: int) -> list[Edge]:
        """The edges, both ways, whose later frame is one of `run`, sorted."""
        for i in range(max(run.start - reach, 0), run.stop):
            if i not in self.chosen:
                self.chosen[i] = long_edges(self.near, self.T, self.per_frame, [i])
                self.near.release()
        self.chosen = {i: edges for i, edges in self.chosen.items() if i >= run.start - reach}
        found = {edge for edges in self.chosen.values() for edge in edges} | self.others
        return sorted(edge for edge in found if max(edge) in run)


def _packed(matcher: Matcher, flow: Flows, scene: np.ndarray | None) -> tuple[dict[str, Packed], int]:
    """Flow and confidence of a block as pairs.arrow holds them, and the number of confident pixels."""
    edges = list(flow)

    def of_edge(edge: Edge) -> tuple[pa.Buffer, pa.Buffer, int]:
        confidence = matcher.confidence(edge, flow)
        if scene is not None:
            confidence = confidence * within(scene, flow[edge])
        confidence = confidence.astype(np.float16, copy=False)
        return pack(stored(flow[edge])), pack(confidence), int((confidence > 0.5).sum())

    if not edges:
        return {}, 0
    flows, confidences, sure = zip(*threaded(of_edge, edges), strict=True)
    shape = flow[edges[0]].shape
    return {"flow": Packed(flows, shape), "confidence": Packed(confidences, shape[:2])}, sum(sure)


def stored(flow: np.ndarray) -> np.ndarray:
    """Flow [h, w, 2] px as pairs.arrow holds it: float16, clipped to twice the longer side of the frame.

    The relative rounding error is at most 1/2048, 0.06 px at 128 px; it averages out over the pixels that determine a
    camera. Clipping keeps float16 finite: true flow of points beside the camera has no upper limit.
    """
    longest = 2 * max(flow.shape[:2])
    return np.clip(flow, -longest, longest).astype(np.float16)
