"""The held-out frames, for every stage that trains on images or scores them."""

import numpy as np
from pydantic import Field

from stages.shared.errors import OptionError
from stages.shared.options import Options


class SplitOptions(Options):
    """The held-out frames: the 0-based indices first, first + every, first + 2 every, ..."""

    holdout_every: int = Field(8, ge=2, description="one frame in this many is held out from training")
    holdout_first: int = Field(4, ge=0, description="0-based index of the first held-out frame")


def held_out(T: int, options: SplitOptions) -> np.ndarray:
    """Mask [T], true for held-out frames: no stage after the adjustment may read their images, masks and flow.

    Flow, masks, poses and depth are estimated from all frames, these included.

    Raises:
        OptionError: if fewer than two frames are left to train on.
    """
    index = np.arange(T)
    late_enough = index >= options.holdout_first
    found = late_enough & ((index - options.holdout_first) % options.holdout_every == 0)
    if T - found.sum() < 2:
        left = f"{T - found.sum()} of {T}, with frame {options.holdout_first + 1} held out first"
        raise OptionError(["holdout_every"], "at least 2 frames to train on", left, "raise it, or `holdout_first`")
    return np.asarray(found)


def frame_times(T: int) -> np.ndarray:
    """Times [T] of all frames, evenly spread over 0..1."""
    return np.arange(T) / (T - 1)
