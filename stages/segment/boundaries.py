"""Boundaries of masks on pixels: along the edges of a frame, then by the colours of it and of others near by."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from stages.segment.colours import Learnt, colour_evidence, learn
from stages.segment.options import SegmentOptions
from stages.segment.permanence import DYNAMIC
from stages.segment.refinement import guarded_threshold, smooth_along_edges, to_mask

OTHERS = -6, -3, 3, 6
"""Distances in frames of the others whose colours are learnt too: a leg that is lost here is found there."""


class _Frame(NamedTuple):
    """A frame [H, W, 3], how surely its pixels move [H, W], and the threshold of its mask."""

    rgb: np.ndarray
    sureness: np.ndarray
    threshold: float


class Boundaries:
    """Masks on pixels of the frames of a clip, asked for in their order: what is past is forgotten."""

    def __init__(
        self,
        T: int,
        picture: Callable[[int], np.ndarray],
        sure: Callable[[int], np.ndarray],
        shown: Callable[[int], np.ndarray | None],
        options: SegmentOptions,
    ) -> None:
        """T frames: picture k [H, W, 3] uint8, how surely [h, w] it moves, and what pictures show of it, in -1..1."""
        self.T, self.picture, self.sure, self.shown, self.options = T, picture, sure, shown, options
        self._smoothed: dict[int, _Frame] = {}
        self._learnt: dict[int, Learnt] = {}

    def mask(self, k: int) -> tuple[np.ndarray, bool]:
        """The mask [H, W] bool of frame k, and whether it was cut back, as it would be nearly full."""
        near = [k + step for step in (0, *OTHERS) if 0 <= k + step < self.T]
        for j in near:
            if j not in self._learnt:
                self._smoothed[j] = self._smooth(j)
                self._learnt[j] = learn(self._smoothed[j].sureness, self._smoothed[j].rgb)
        rgb, sureness, threshold = self._smoothed.pop(k)
        if threshold == DYNAMIC:  # else its surest part is wanted, and not that of the clearest colours
            sureness = self._along_edges(k, rgb, colour_evidence(sureness, rgb, [self._learnt[j] for j in near[1:]]))
        self._learnt.pop(k + min(OTHERS), None)
        return to_mask(sureness, threshold, self.options.min_area), threshold > DYNAMIC

    def _smooth(self, k: int) -> _Frame:
        rgb = self.picture(k)
        sureness = self._along_edges(k, rgb)
        return _Frame(rgb, sureness, guarded_threshold(sureness, DYNAMIC, self.options.max_share))

    def _along_edges(self, k: int, rgb: np.ndarray, colours: np.ndarray | None = None) -> np.ndarray:
        smoothing = self.options.smoothness, self.options.colour_sigma
        return smooth_along_edges(self.sure(k), rgb, *smoothing, self.shown(k), colours)
