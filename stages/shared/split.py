"""Which frames are held out from training, for every stage that trains or scores images."""

import numpy as np
from pydantic import Field

from stages.shared.options import Options


class SplitOptions(Options):
    """The held-out frames: 0-based first, first + every, ..."""

    holdout_every: int = Field(8, ge=2, description="one frame in this many is held out from training")
    holdout_first: int = Field(4, ge=0, description="0-based index of the first held-out frame")


def held_out(T: int, options: SplitOptions) -> np.ndarray:
    """Mask [T], true for frames whose pictures, masks and edges no stage after the adjustment may read.

    They do take part before: flow, masks, poses and depth are estimated from all frames.
    """
    index = np.arange(T)
    late_enough = index >= options.holdout_first
    return np.asarray(late_enough & ((index - options.holdout_first) % options.holdout_every == 0))


def frame_times(T: int) -> np.ndarray:
    """Times [T] of all frames, 0..1."""
    return np.arange(T) / (T - 1)
