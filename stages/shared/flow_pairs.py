"""The flow of a clip, read edge by edge: the flow of a thousand frames does not fit into memory."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from stages.shared.artifacts import Dense
from stages.shared.cameras import pixel_grid
from stages.shared.log import progress
from stages.shared.masks import within
from stages.shared.threads import threaded

ResultT = TypeVar("ResultT")
MIN_WEIGHT = 0.1
REACH = 64
"""Edges over more frames than this join frames that see a place again, where other things may stand by now."""
BLOCK = 8
"""Frames whose flow is held at the same time."""


@dataclass(frozen=True)
class FlowPairs:
    """The edges of flow/pairs.arrow, sorted by source, and how much each pixel counts.

    Attributes:
        columns: source, target [E] frames; flow [E, h, w, 2] px and confidence [E, h, w], mapped from the file.
        counts: [E] bool, whether an edge is evidence; None: all are.
        scene: [h, w] bool, false where something is burnt into the frames; None: nowhere.
    """

    columns: Dense
    counts: np.ndarray | None = None
    scene: np.ndarray | None = None

    @property
    def source(self) -> np.ndarray:
        """The frame [E] that each edge leaves."""
        return self.columns["source"]

    @property
    def target(self) -> np.ndarray:
        """The frame [E] that each edge reaches."""
        return self.columns["target"]

    @property
    def flow(self) -> np.ndarray:
        """Flow [E, h, w, 2] px, float16."""
        return self.columns["flow"]

    @property
    def confidence(self) -> np.ndarray:
        """Confidence of the flow [E, h, w] in 0..1, float16."""
        return self.columns["confidence"]

    @cached_property
    def edges(self) -> dict[tuple[int, int], int]:
        """(source, target) -> row."""
        return {(int(i), int(j)): e for e, (i, j) in enumerate(zip(self.source, self.target, strict=True))}

    @cached_property
    def pixels(self) -> np.ndarray:
        """Pixels of the flow grid [h, w, 2], float32."""
        return pixel_grid(*self.confidence.shape[1:]).astype(np.float32)

    def leaving(self, first: int, last: int) -> range:
        """Rows of the edges that leave the frames first..last - 1."""
        begin, end = np.searchsorted(self.source, (first, last))
        return range(int(begin), int(end))

    def matches(self, edge: int) -> np.ndarray:
        """Where an edge takes the pixels [h, w, 2], float32."""
        return np.asarray(self.pixels + self.flow[edge].astype(np.float32))

    def weights(self, edge: int) -> np.ndarray:
        """Weights [h, w] float32 of an edge as evidence of motion: its confidence, with a small minimum.

        Objects that move fast or rotate are matched badly in every pair. Flow that fits neither a static world nor the
        backward flow is weak evidence of motion, and often the only one. Flow that leaves the frame, or the scene in
        it, has weight 0.
        """
        from stages.shared.flow_kernels import weigh  # compiled code; most of what reads REACH here needs none

        weights = self.confidence[edge].astype(np.float32)  # half precision is slow to compare
        if self.counts is not None and not self.counts[edge]:
            return np.zeros_like(weights)
        flow = self.flow[edge].astype(np.float32)
        weigh(flow, weights, MIN_WEIGHT)
        return weights if self.scene is None else weights * within(self.scene, flow)

    def counting(self, counts: np.ndarray) -> "FlowPairs":
        """The same pairs, of which only some [E] are evidence."""
        return replace(self, counts=counts)

    def threaded(self, function: Callable[..., ResultT], items: Sequence[Any]) -> list[ResultT]:
        """Like `threads.threaded`; the flow that was read is given back from run to run of the items."""
        found = []
        for first in range(0, len(items), BLOCK):
            found += threaded(function, items[first : first + BLOCK])
            self.columns.release()
        return found

    def blocks(self, T: int, title: str) -> Iterator[tuple[int, int]]:
        """First frame and end of the runs of at most BLOCK frames; the flow read for a run is given back after it.

        Args:
            title: of the progress over the runs.
        """
        for first in progress(range(0, T, BLOCK), title):
            yield first, min(first + BLOCK, T)
            self.columns.release()
