"""Near-duplicate frames and cuts: which frames of a video are used, and in which shots."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np

from stages.shared.images import reduce, reduced_size
from stages.shared.sequences import MIN_FRAMES

CUT_WIDTH_PX = 128
SAME_SHOT = 0.3
"""Least correlation of a frame with the one before, warped onto it, within a shot.

Of 970 pairs of neighbouring frames of 40 clips (the scene library, Sintel, one hand-held) the least was 0.61, at half
the frame rate 0.31; of 600 pairs of frames of different clips the largest was 0.25.
"""
WINDOW_PX = 9
NOISE = 4.0
"""Variance that noise and coding may have; it keeps dark and flat areas from deciding."""
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
    """

    pts: list[int] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)
    seen: int = 0


@dataclass
class Found:
    """The shots of a video, and what was left out.

    Attributes:
        shots: of at least three frames. times_s: of all frames looked at. duplicates_s: times of repeated frames.
        cuts_s: times of the first frames after cuts. left_out_s: times of the frames of shorter shots.
        complete: false if frames are left because `max_frames` were found.
    """

    shots: list[Shot] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)
    duplicates_s: list[float] = field(default_factory=list)
    cuts_s: list[float] = field(default_factory=list)
    left_out_s: list[float] = field(default_factory=list)
    complete: bool = True


def find_shots(looks: Iterable[Look], every: int, max_frames: int | None) -> Found:
    """Divide frames at cuts, and take one in `every` that does not repeat the last one taken.

    Cuts are looked for between all frames, however many are used: at a distance frames of one shot differ as well. One
    or two foreign frames between frames that continue each other, a flash or a broken frame, are left out, and no cut.

    Args:
        max_frames: stop after so many frames; None: take all.
    """
    found = Found()
    parts: list[Shot] = []
    before = parted = kept = None
    for look in looks:
        small = reduce(look.grey, reduced_size(look.grey.shape[1], look.grey.shape[0], CUT_WIDTH_PX))
        if before is None or not continues(before, small):
            if parted is not None and parts[-1].seen < MIN_FRAMES and continues(parted, small):
                found.left_out_s += parts.pop().times_s
                found.cuts_s.pop()
            else:
                found.cuts_s += [look.time_s] if parts else []
                parts.append(Shot())
                parted = before
            kept = None
        shot, before = parts[-1], small
        found.times_s.append(look.time_s)
        shot.seen += 1
        if (shot.seen - 1) % every:
            continue
        if kept is not None and repeats(kept, look.grey):
            found.duplicates_s.append(look.time_s)
            continue
        if max_frames is not None and sum(len(part.pts) for part in parts) >= max_frames:
            found.complete = False
            break
        shot.pts.append(look.pts)
        shot.times_s.append(look.time_s)
        kept = look.grey
    found.shots = [part for part in parts if len(part.pts) >= MIN_FRAMES]
    found.left_out_s += [time for part in parts if len(part.pts) < MIN_FRAMES for time in part.times_s]
    return found


def continues(before: np.ndarray, after: np.ndarray) -> bool:
    """Whether a frame [h, w] uint8 continues the one before, by their correlation once warped by the flow between them.

    The correlation is that of windows about their means, which does not depend on exposure.
    """
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST).calc(after, before, None)
    v, u = np.indices(after.shape, np.float32)
    warped = cv2.remap(before, u + flow[..., 0], v + flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return correlation(warped, after) >= SAME_SHOT


def correlation(first: np.ndarray, second: np.ndarray) -> float:
    """Correlation of two images [h, w] within windows, over all of them together; 1 for flat images."""
    a, b = first.astype(np.float32), second.astype(np.float32)
    means = [cv2.blur(image, (WINDOW_PX, WINDOW_PX)) for image in (a, b)]
    products = (a * b, a * a, b * b)
    expected = (means[0] * means[1], means[0] ** 2, means[1] ** 2)
    shared, of_a, of_b = (
        float(np.mean(cv2.blur(product, (WINDOW_PX, WINDOW_PX)) - mean)) + NOISE
        for product, mean in zip(products, expected, strict=True)
    )
    return shared / float(np.sqrt(of_a * of_b))


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
