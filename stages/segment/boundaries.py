"""Boundaries of masks on pixels: along the edges of a frame, then by the colours of it and of others near by."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from stages.segment.colours import Learnt, colour_evidence, learn
from stages.segment.options import SegmentOptions
from stages.segment.permanence import DYNAMIC
from stages.segment.refinement import guarded_threshold, smooth_along_edges, to_mask

TEACHING = -6, -3, 3, 6
"""Distances in frames of those whose colours count too: what is lost, or masked by mistake, in one is not in all."""


class _Frame(NamedTuple):
    """A frame and what it teaches.

    Attributes:
        rgb: [H, W, 3] uint8. known: [h, w] how surely each pixel moves, and what pictures show of it.
        sureness: [H, W] the same along the edges of the frame; threshold: of its mask.
        learnt: None of a frame whose mask is cut back, since it is wrong.
    """

    rgb: np.ndarray
    known: tuple[np.ndarray, np.ndarray | None]
    sureness: np.ndarray
    threshold: float
    learnt: Learnt | None


def masks_on_pixels(
    T: int,
    picture: Callable[[int], np.ndarray],
    known: Callable[[int], tuple[np.ndarray, np.ndarray | None]],
    options: SegmentOptions,
) -> Iterator[tuple[np.ndarray, bool]]:
    """The mask [H, W] bool of each of T frames in turn, and whether it was cut back, as it would be nearly full.

    Args:
        picture: gives frame k [H, W, 3] uint8, once.
        known: gives how surely each of its pixels moves [h, w], 0..1, and what pictures show of it, in -1..1, if known.
    """
    taught: dict[int, Learnt | None] = {}
    ahead: dict[int, _Frame] = {}
    for k in range(T):
        for j in range(max(ahead, default=-1) + 1, min(k + max(TEACHING) + 1, T)):
            ahead[j] = _frame(picture(j), known(j), options)
            taught[j] = ahead[j].learnt
        frame = ahead.pop(k)
        sureness, threshold = frame.sureness, frame.threshold
        if frame.learnt:  # else its surest part is wanted, and not that of the clearest colours
            others = [learnt for step in TEACHING if (learnt := taught.get(k + step))]
            colours = colour_evidence(sureness, frame.rgb, frame.learnt, others)
            sureness = _along_edges(frame.known, frame.rgb, options, colours)
            threshold = guarded_threshold(sureness, DYNAMIC, options.max_share)
        taught.pop(k + min(TEACHING), None)
        yield to_mask(sureness, threshold, options.min_area), threshold > DYNAMIC


def _frame(rgb: np.ndarray, known: tuple[np.ndarray, np.ndarray | None], options: SegmentOptions) -> _Frame:
    sureness = _along_edges(known, rgb, options)
    threshold = guarded_threshold(sureness, DYNAMIC, options.max_share)
    return _Frame(rgb, known, sureness, threshold, learn(sureness, rgb) if threshold == DYNAMIC else None)


def _along_edges(
    known: tuple[np.ndarray, np.ndarray | None],
    rgb: np.ndarray,
    options: SegmentOptions,
    colours: np.ndarray | None = None,
) -> np.ndarray:
    sure, shown = known
    return smooth_along_edges(sure, rgb, options.smoothness, options.colour_sigma, shown, colours)
