"""Reading what the adjustment needs of a clip, some frames at a time: flow and images."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from stages.ba import cuts, given
from stages.ba.graph import EDGES, FlowGraph, build_graph
from stages.ba.options import BAOptions
from stages.ba.texture import texture_weights
from stages.shared.artifacts import Dense, read_dense, read_metadata
from stages.shared.images import read_reduced
from stages.shared.rows import OFTEN_READ_BYTES
from stages.shared.sequences import Sequence
from stages.shared.threads import threaded

BLOCK = 64
"""Frames whose images, or whose finer matches, are held at the same time."""


@dataclass(frozen=True)
class Matches:
    """The content of flow/pairs.arrow for T frames.

    Attributes:
        columns: columns of the table, one row per edge.
        shot: [T] bool, the frames to solve.
        size: (width, height) of the flow grid; scale: its width over that of the frames.
        border_px: as of `FlowGraph`.
    """

    columns: Dense
    shot: np.ndarray
    size: tuple[int, int]
    scale: float
    border_px: float = 0.0

    def graph(self, stride: int, known: given.Known, frames: tuple[int, int] | None = None) -> FlowGraph:
        """The unmasked matches of the shot, one pixel per `stride` px each way.

        Args:
            frames: first and end of those whose edges are read; None: all.
        """
        begin, end = np.searchsorted(self.columns["source"], frames or (0, len(self.shot)))
        source, target = (self.columns[name][begin:end] for name in ("source", "target"))
        images = self.columns["flow"], self.columns["confidence"]  # a slice of packed rows would hold all of them
        T, lens, release, first = len(self.shot), (known.centre, known.aspect), self.columns.release, int(begin)
        graph = build_graph(source, target, *images, T, stride, *lens, release, first=first, border_px=self.border_px)
        self.columns.release()
        return cuts.isolate(graph, self.shot)


def read_matches(flow: Path, T: int, options: BAOptions) -> Matches:
    """The matches of T frames, of which the longest shot is to be solved, or all where poses are given."""
    about, columns, stride = read_metadata(flow), read_dense(flow, OFTEN_READ_BYTES), options.stride_px
    shot = np.ones(T, bool)
    if not options.poses_fixed:
        sampled = []
        for first in range(0, len(columns["source"]), EDGES):
            block = columns["confidence"][first : first + EDGES, stride // 2 :: stride, stride // 2 :: stride]
            sampled.append(block.reshape(len(block), -1).copy())
            columns.release()
        shot = cuts.linked_frames(columns["source"], columns["target"], np.concatenate(sampled), T)
    size = int(about["width"]), int(about["height"])
    return Matches(columns, shot, size, float(about["scale"]), float(about.get("border_px", 0)))


def read_texture(frames: Sequence, size: tuple[int, int]) -> Iterator[np.ndarray]:
    """Texture weights [height, width] of each frame on the flow grid."""
    for first in range(0, len(frames.frames), BLOCK):
        read = read_reduced(frames.frames[first : first + BLOCK], size)
        yield from threaded(texture_weights, (cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) for rgb in read))
