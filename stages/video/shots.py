"""Near-duplicate frames and cuts: which frames of a video are used, and in which shots."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from stages.shared.dataset_folders import MIN_FRAMES
from stages.shared.images import reduce, reduced_size
from stages.video.likeness import continues, continues_coarsely, repeats, shows_nothing

CUT_SIDE_PX = 128
FOREIGN = 5
"""Up to so many frames between frames that continue each other are no shot: flashes, broken frames, a mover that fills
the view."""


class Look(NamedTuple):
    """A frame in brightness, [h, w] uint8, with a longer side of at most 512 px, and its time stamp in the file."""

    pts: int
    time_s: float
    grey: np.ndarray


@dataclass
class Shot:
    """A run of frames without a cut.

    Attributes:
        pts, times_s: of the frames used. seen: number of frames, with those that are not used.
        first: number of its first frame among those used of the clip, from 1 on. blank: whether it shows nothing.
    """

    pts: list[int] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)
    seen: int = 0
    first: int = 1
    blank: bool = False


def cut_out(shot: Shot, first: int, last: int) -> Shot:
    """The frames `first` to `last` of a shot, by their numbers."""
    inside = slice(first - shot.first, last - shot.first + 1)
    return Shot(shot.pts[inside], shot.times_s[inside], last - first + 1, first)


@dataclass
class Found:
    """The shots of a clip, and what was left out.

    Attributes:
        shots: of at least three frames. times_s: of all frames looked at. duplicates_s: times of repeated frames.
        cuts_s: times of the first frames after cuts. left_out_s: times of the frames of shorter and of blank shots.
        complete: false if frames are left because `max_frames` were found.
    """

    shots: list[Shot] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)
    duplicates_s: list[float] = field(default_factory=list)
    cuts_s: list[float] = field(default_factory=list)
    left_out_s: list[float] = field(default_factory=list)
    complete: bool = True


class Cutter:
    """Divides a clip at its cuts, one frame after the other.

    Up to FOREIGN frames between frames that continue each other are no shot, and blank frames are one of their own.
    """

    def __init__(self) -> None:
        self.parts: list[Shot] = []
        self.cuts_s: list[float] = []
        self.left_out_s: list[float] = []
        self._before: np.ndarray | None = None
        self._left: tuple[int, np.ndarray] | None = None

    def part_of(self, look: Look) -> Shot:
        """The part to which the next frame belongs; a new one after a cut."""
        grey = look.grey
        small = reduce(grey, reduced_size(grey.shape[1], grey.shape[0], CUT_SIDE_PX))
        before, self._before = self._before, small
        blank = shows_nothing(small)
        if not blank and self._returns(small):
            return self.parts[-1]
        if before is None or blank != self.parts[-1].blank or not (blank or continues(before, small)):
            if before is not None:
                self.cuts_s.append(look.time_s)
                if self._left is None and not self.parts[-1].blank:
                    self._left = len(self.parts), before
            self.parts.append(Shot(blank=blank))
        return self.parts[-1]

    def _returns(self, small: np.ndarray) -> bool:
        """Whether a frame continues the shot that was left a few frames ago; what came between is left out then."""
        if self._left is None:
            return False
        count, last = self._left
        foreign = self.parts[count:]
        if sum(part.seen for part in foreign) > FOREIGN:
            self._left = None
            return False
        if not continues_coarsely(last, small):
            return False
        self.left_out_s += [time for part in foreign for time in part.times_s]
        del self.parts[count:], self.cuts_s[len(self.cuts_s) - len(foreign) :]
        self._left = None
        return True


def find_shots(
    looks: Iterable[Look], every: int = 1, max_frames: int | None = None, cuts: bool = True, repeated: bool = False
) -> Found:
    """Divide frames at cuts, and take one in `every` that does not repeat the last one taken.

    Cuts are looked for between all frames, however many are used: at a distance frames of one shot differ as well.

    Args:
        max_frames: stop after so many frames; None: take all.
        cuts: whether to look for cuts; else all frames are one shot. repeated: take also frames that repeat others.
    """
    found, cutter = Found(), Cutter()
    one, shot = Shot(), None
    kept: np.ndarray | None = None
    taken = 0
    for look in looks:
        before, shot = shot, cutter.part_of(look) if cuts else one
        if shot is not before:
            kept = None
        found.times_s.append(look.time_s)
        shot.seen += 1
        if (shot.seen - 1) % every:
            continue
        if not repeated and kept is not None and repeats(kept, look.grey):
            found.duplicates_s.append(look.time_s)
            continue
        if max_frames is not None and taken >= max_frames:
            found.complete = False
            break
        taken += 1
        shot.first = shot.first if shot.pts else taken
        shot.pts.append(look.pts)
        shot.times_s.append(look.time_s)
        kept = look.grey
    _choose(found, cutter.parts if cuts else [one])
    found.cuts_s, found.left_out_s = cutter.cuts_s, cutter.left_out_s + found.left_out_s
    return found


def _choose(found: Found, parts: list[Shot]) -> None:
    """Put the parts that are long enough under the shots found: those that show something, if there are any."""
    long = [part for part in parts if len(part.pts) >= MIN_FRAMES]
    found.shots = [part for part in long if not part.blank] or long
    found.left_out_s = [time for part in parts if part not in found.shots for time in part.times_s]
