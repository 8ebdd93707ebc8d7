"""Near-duplicate frames and cuts: which frames of a video are used, and in which shots."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np

from stages.shared.dataset_folders import MIN_FRAMES
from stages.shared.images import reduce, reduced_size

CUT_WIDTH_PX = 128
SAME_SHOT, SAME_SHOT_FINE = 0.35, 0.48
"""Least correlation of a frame with the one before, warped onto it, within a shot: by coarse flow, and by fine flow.

Fine flow also makes frames of different clips alike. Of 870 pairs of neighbouring frames of 24 clips (the tuned scenes,
Sintel, one hand-held) the least was 0.53 by the flow that fits best; of 300 pairs of frames of different clips the
largest were 0.25 by coarse and 0.34 by fine flow, and 0.45 between smooth random textures.
"""
FOREIGN = 5
"""Up to so many frames between frames that continue each other are no shot: flashes, broken frames, a mover that fills
the view."""
WINDOW_PX = 9
NOISE = 4.0
"""Variance that noise and coding may have; it keeps dark and flat areas from deciding."""
BLANK = 2 * NOISE
"""Variance within windows of frames that show nothing, as between fades: at less, noise makes any two frames alike. The
least of the tuned scenes is 28, in fog."""
DUPLICATE_LEVELS = 4.0
BLOCK_PX = 16
"""A frame repeats the last one used if no block of this size, of a frame 512 px wide, changes by more than these grey
levels on average. H.264 at crf 20 changed repeated frames by at most 3.1 (at crf 28 by 3.7 in the median); the slowest
motion of the clips above changed frames by 10.4. Slower motion is thinned out: compared is the last frame used."""


class Look(NamedTuple):
    """A frame in brightness, [h, w] uint8 and at most 512 px wide, and its time stamp in the file."""

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
        small = reduce(grey, reduced_size(grey.shape[1], grey.shape[0], CUT_WIDTH_PX))
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


def continues(before: np.ndarray, after: np.ndarray) -> bool:
    """Whether a frame [h, w] uint8 continues the one before, by their correlation once warped by the flow between them.

    The correlation is that of windows about their means, which does not depend on exposure. Coarse flow decides nearly
    all pairs. Where it does not fit, it starts from the best translation, as fast pans need it; then fine flow is
    searched, both ways, for fast movers and few pixels in common.
    """
    fine = cv2.DISOPTICAL_FLOW_PRESET_MEDIUM
    return (
        continues_coarsely(before, after)
        or warped_correlation(before, after, fine) >= SAME_SHOT_FINE
        or warped_correlation(after, before, fine) >= SAME_SHOT_FINE
    )


def continues_coarsely(before: np.ndarray, after: np.ndarray) -> bool:
    """As `continues`, without fine flow."""
    coarse = cv2.DISOPTICAL_FLOW_PRESET_FAST
    return (
        warped_correlation(before, after, coarse) >= SAME_SHOT
        or warped_correlation(before, after, coarse, translation(before, after)) >= SAME_SHOT
    )


def warped_correlation(
    before: np.ndarray, after: np.ndarray, preset: int, start_px: tuple[float, float] = (0, 0)
) -> float:
    """Correlation of a frame [h, w] uint8 with the one before, warped by DIS flow from a first translation (x, y)."""
    start = np.broadcast_to(np.array(start_px, np.float32), (*after.shape, 2)).copy()
    flow = cv2.DISOpticalFlow.create(preset).calc(after, before, start)
    v, u = np.indices(after.shape, np.float32)
    warped = cv2.remap(before, u + flow[..., 0], v + flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return correlation(warped, after)


def translation(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """The translation (x, y) px from `after` to `before` at which they correlate most in their details."""
    first, second = (
        image.astype(np.float32) - cv2.blur(image.astype(np.float32), (WINDOW_PX, WINDOW_PX))
        for image in (before, after)
    )
    (x, y), _ = cv2.phaseCorrelate(first, second, cv2.createHanningWindow(after.shape[::-1], cv2.CV_32F))
    return -x, -y


def shows_nothing(image: np.ndarray) -> bool:
    """Whether an image [h, w] uint8 is flat, as all black or all white."""
    return variance(image.astype(np.float32)) < BLANK


def variance(image: np.ndarray) -> float:
    """Variance of an image [h, w] float32 within windows, over all of them together."""
    size = WINDOW_PX, WINDOW_PX
    return float(np.mean(cv2.blur(image * image, size) - cv2.blur(image, size) ** 2))


def correlation(first: np.ndarray, second: np.ndarray) -> float:
    """Correlation of two images [h, w] within windows, over all of them together; 1 for flat images."""
    a, b = first.astype(np.float32), second.astype(np.float32)
    size = WINDOW_PX, WINDOW_PX
    shared = float(np.mean(cv2.blur(a * b, size) - cv2.blur(a, size) * cv2.blur(b, size))) + NOISE
    return shared / float(np.sqrt((variance(a) + NOISE) * (variance(b) + NOISE)))


def repeats(kept: np.ndarray, image: np.ndarray) -> bool:
    """Whether no block of an image [h, w] uint8 differs from that of the last one used by more than coding does."""
    changed = cv2.blur(cv2.absdiff(kept, image).astype(np.float32), (BLOCK_PX, BLOCK_PX))
    return bool(changed.max() < DUPLICATE_LEVELS)


def irregular(times_s: Iterable[float]) -> bool:
    """Whether the intervals between frames vary by more than the rounding of time stamps."""
    intervals = np.diff(list(times_s))
    return bool(len(intervals) > 1 and intervals.max() > 1.5 * np.median(intervals))


def spans(times_s: Iterable[float], gap_s: float) -> Iterator[tuple[float, float]]:
    """Times in runs (first, last), whose steps are at most `gap_s`."""
    ordered = sorted(times_s)
    start = 0
    for k in range(1, len(ordered) + 1):
        if k == len(ordered) or ordered[k] - ordered[k - 1] > gap_s:
            yield ordered[start], ordered[k - 1]
            start = k
