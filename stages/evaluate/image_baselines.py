"""Held-out frames interpolated from their neighbours without a scene model: baselines of the reconstruction."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from stages.shared.artifacts import Dense
from stages.shared.images import enlarge, read_rgb
from stages.shared.log import progress
from stages.shared.sequences import Sequence
from stages.shared.split import SplitOptions, held_out
from stages.shared.warp import warp

NEAREST, BLEND, WARP = "nearest training frame", "blend of neighbours", "flow warp of neighbours"
PROTOCOLS = {
    NEAREST: "the training frame nearest in time, the earlier of two",
    BLEND: "the training frames before and after, mixed by their distance in time",
    WARP: "the training frames before and after, each warped to the time between along our flow from one to the other, "
    "then mixed; frames without both neighbours or without an edge between them are left out",
}


@dataclass(frozen=True)
class Made:
    """A held-out frame and the prediction of every baseline, [H, W, 3] uint8 by name."""

    number: int
    truth: np.ndarray
    images: dict[str, np.ndarray]


def made_frames(sequence: Sequence, flow: Dense, options: SplitOptions) -> Iterator[Made]:
    """Every held-out frame with the predictions of the baselines.

    Args:
        flow: columns of flow/pairs.arrow (source, target, flow).
    """
    test = held_out(len(sequence.frames), options)
    train = np.flatnonzero(~test)
    edges = {edge: e for e, edge in enumerate(zip(flow["source"].tolist(), flow["target"].tolist(), strict=True))}
    for k in progress(np.flatnonzero(test).tolist(), "baselines"):
        before, after = train[train < k][-1:], train[train > k][:1]
        ends = [int(end) for end in (*before, *after)]
        first, last = (read_rgb(sequence.frames[end]) for end in (ends[0], ends[-1]))
        share = (k - ends[0]) / (ends[-1] - ends[0]) if len(ends) == 2 else 0.0
        images = {NEAREST: first if share <= 0.5 else last, BLEND: mix(first, last, share)}
        there, back = edges.get((ends[0], ends[-1])), edges.get((ends[-1], ends[0]))
        if there is not None and back is not None:
            images[WARP] = between(first, last, flow["flow"][there], flow["flow"][back], share)
            flow.release()
        yield Made(sequence.numbers[k], read_rgb(sequence.frames[k]), images)


def mix(first: np.ndarray, last: np.ndarray, share: float) -> np.ndarray:
    """Images [H, W, 3] uint8 mixed, `share` of the last one."""
    return np.rint((1 - share) * first.astype(float) + share * last).astype(np.uint8)


def between(first: np.ndarray, last: np.ndarray, there: np.ndarray, back: np.ndarray, share: float) -> np.ndarray:
    """The frame at time `share` (0: first, 1: last), both warped along linear motion (Jiang et al. 2018, eq. 4).

    Args:
        there, back: flow [h, w, 2] in pixels of its own grid, from the first frame to the last and from last to first.
    """
    height, width = first.shape[:2]
    enlarged = (enlarge(f.astype(np.float32), (width, height)) * (width / f.shape[1]) for f in (there, back))
    forward, backward = enlarged
    to_first = share * (share * backward - (1 - share) * forward)
    to_last = (1 - share) * ((1 - share) * forward - share * backward)
    return mix(warp(first, to_first), warp(last, to_last), share)
