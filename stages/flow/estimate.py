"""Flow by dense inverse search, and flow that the user hands in, with confidence."""

from collections import ChainMap
from collections.abc import Mapping
from typing import TYPE_CHECKING, cast

import numpy as np

from stages.flow.averaging import Frames
from stages.flow.confidence import flow_confidence
from stages.flow.dis import estimate_flow
from stages.flow.edges import Edge
from stages.flow.lost import with_lost
from stages.flow.matches import restarted_pair
from stages.flow.passes import Flows
from stages.given.flow import GivenFlow
from stages.shared.threads import threaded
from stages.shared.warp import is_inside

if TYPE_CHECKING:
    from stages.flow.loops import Loop


class Estimate:
    """Flow between frames, estimated where it is not given (a `passes.Matcher`).

    Given edges are matched both ways, also where they are longer than the others.
    """

    def __init__(self, frames: Frames, offsets: tuple[int, ...], given: Mapping[Edge, GivenFlow], threads: int) -> None:
        self.frames, self.given, self.threads, self.step = frames, given, threads, min(offsets)
        longer = {edge for edge in given if abs(edge[1] - edge[0]) not in offsets}
        self.others = frozenset(longer | {edge[::-1] for edge in longer})
        self.known = {edge: of.flow for edge, of in given.items()}

    def near(self, edges: list[Edge], near: Mapping[Edge, np.ndarray]) -> tuple[Flows, int]:
        """Neighbours first; those with large motion again from sparse matches, and what is lost by patches; the others
        from chains of all."""
        self._make_ready(edges)
        flow: Flows = {edge: self.known[edge] for edge in edges if edge in self.known}
        neighbours = [(i, j) for i, j in edges if abs(j - i) == self.step]
        flow |= self._estimated([edge for edge in neighbours if edge not in flow], {})
        pairs = [(i, j) for i, j in neighbours if i < j and not {(i, j), (j, i)} <= set(self.known)]
        found = threaded(lambda pair: self._restarted(flow, pair), pairs)
        anew = {edge: of for of_pair in found for edge, of in of_pair.items() if edge not in self.known}
        flow |= anew
        searched = [edge for edge in neighbours if edge not in self.known]
        flow |= zip(searched, threaded(lambda edge: self._with_lost(flow, edge), searched), strict=True)
        flow |= self._estimated([edge for edge in edges if edge not in flow], ChainMap(flow, cast(Flows, near)))
        return {edge: flow[edge] for edge in edges}, len(anew)

    def far(self, edges: list[Edge], near: Mapping[Edge, np.ndarray], far: Mapping[Edge, np.ndarray]) -> Flows:
        """From chains of near flow, of shorter far flow, and of what is given."""
        self._make_ready(edges)
        at_hand = ChainMap(self.known, cast(Flows, near), cast(Flows, far))
        estimated = self._estimated([edge for edge in edges if edge not in self.known], at_hand)
        return {edge: self.known[edge] if edge in self.known else estimated[edge] for edge in edges}

    def loops(self, near: Mapping[Edge, np.ndarray], scene: np.ndarray | None) -> list["Loop"]:
        """Frames too far apart for a chain that show the same place, by what they show; those given are left out."""
        from stages.flow.loops import find_loops  # short clips do not need it

        return [loop for loop in find_loops(self.frames.grey, near, scene) if loop.pair not in self.others]

    def closed(self, loops: list["Loop"]) -> Flows:
        """Both edges of every loop."""
        from stages.flow.loop_flow import loop_flow  # imports much of scipy, which clips without loops do not need

        return loop_flow(self.frames.grey, loops, self.frames.finest_scale)

    def confidence(self, edge: Edge, flow: Flows) -> np.ndarray:
        """As `flow_confidence`, or as the user states it; zero where given flow is not known."""
        (i, j), grey = edge, self.frames.grey
        of = self.given.get(edge)
        if of is not None and of.confidence is not None:
            return (of.confidence * (of.known & is_inside(of.flow))).astype(np.float16)
        found = flow_confidence(flow[i, j], flow[j, i], grey[i], grey[j], self.frames.textured[i])
        return (found if of is None else found * of.known).astype(np.float16)

    def _make_ready(self, edges: list[Edge]) -> None:
        """Read the frames of the edges: threads that want the same one would each read it."""
        frames = sorted({frame for edge in edges for frame in edge})
        threaded(lambda k: (self.frames.grey[k], self.frames.textured[k]), frames)

    def _estimated(self, edges: list[Edge], known: Mapping[Edge, np.ndarray]) -> Flows:
        return estimate_flow(self.frames.grey, edges, self.frames.finest_scale, self.threads, known)

    def _with_lost(self, flow: Flows, edge: Edge) -> np.ndarray:
        return with_lost(flow[edge], self.frames.grey[edge[0]], self.frames.grey[edge[1]], self.frames.finest_scale)

    def _restarted(self, flow: Flows, pair: Edge) -> Flows:
        return restarted_pair(self.frames.rgb, self.frames.grey, flow, pair, self.frames.finest_scale)
