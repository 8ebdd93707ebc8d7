"""What is told of a video: findings by name, and warnings in words."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from stages.shared.dataset_folders import MIN_FRAMES
from stages.video import decode
from stages.video.options import VideoOptions
from stages.video.orientation import display_matrix
from stages.video.shots import Found


def describe(video: Path, header: decode.Header, first: decode.Frame, found: Found, interlaced: bool) -> dict[str, Any]:
    """Codec, rotation, frame rate, repeated frames, cuts, ... by name."""
    return {
        "video": str(video.resolve()),
        "codec": header.codec,
        "pixel_format": first.image.format.name,
        "bits": first.image.format.components[0].bits,
        "coded_size": [first.image.width, first.image.height],
        "pixel_aspect": header.aspect,
        "rotation_deg": first.image.rotation,
        "interlaced": interlaced,
        "length_s": header.length_s,
        "frame_rate_hz": header.rate_hz,
        "variable_frame_rate": _irregular(found.times_s),
        "frames_read": len(found.times_s),
        "complete": found.complete,
        "duplicates_s": found.duplicates_s,
        "cuts_s": found.cuts_s,
        "left_out_s": found.left_out_s,
    }


def of_bars(bars_px: tuple[int, int]) -> list[str]:
    """A warning for black bars, (left and right, above and below) px, that are cut off."""
    where = zip(("left and right", "above and below"), bars_px, strict=True)
    return [f"black bars {sides} are cut off, {px} px each" for sides, px in where if px]


def of_order(count: int) -> list[str]:
    """A warning about `count` frames out of order."""
    advice = "if recordings were joined, export the video again"
    said = f"{count} frames are left out, whose time stamps are missing or not after those before: {advice}"
    return [said] if count else []


def of_frames(
    header: decode.Header, first: decode.Frame, found: Found, options: VideoOptions, interlaced: bool
) -> list[str]:
    """Warnings about the frames and what was left out of them."""
    warnings = []
    if interlaced:
        warnings.append("the video is interlaced: one field of each frame is interpolated")
    if first.image.color_trc in decode.HDR_TRANSFERS:
        kind = decode.HDR_TRANSFERS[first.image.color_trc]
        warnings.append(f"HDR video ({kind}): its colours are used as they are coded, and look flat")
    if display_matrix(first.image) is None:
        warnings.append(f"its metadata ask for a rotation by {first.image.rotation} degrees, which is left out")
    if _irregular(found.times_s):
        steps = np.diff(found.times_s)
        warnings.append(f"frames are {steps.min():.3f} to {steps.max():.3f} s apart: their own time stamps are kept")
    if found.duplicates_s:
        warnings.append(
            f"{len(found.duplicates_s)} frames repeat the one before and are left out: {in_words(found.duplicates_s)}"
        )
    if found.cuts_s:
        warnings.append(f"cuts at {in_words(found.cuts_s)}: each shot is a sequence of its own")
    if found.left_out_s:
        runs = _spans(found.left_out_s, 2 * options.every * interval_s(header, found))
        parts = [f"{a:.3f}" if a == b else f"{a:.3f}..{b:.3f}" for a, b in runs]
        warnings.append(
            f"shots of fewer than {MIN_FRAMES} frames, flashes and blank frames are left out: {_few(parts)} s"
        )
    if not found.complete:
        warnings.append(_cut_off(header, found, options))
    return warnings


def _cut_off(header: decode.Header, found: Found, options: VideoOptions) -> str:
    """That `max_frames` ended the video early, and which `every` would take in all of it."""
    until = found.shots[-1].times_s[-1]
    used = sum(len(shot.times_s) for shot in found.shots)
    said = f"the first {used} frames are used, up to {until:.3f} s"
    end = min((time for time in (options.end, header.length_s) if time), default=None)
    if end is None or end <= until:
        return f"{said}: see `video: {{max_frames: ...}}`"
    covered = until + options.every * interval_s(header, found) - options.start  # the last frame lasts as well
    every = int(np.ceil(options.every * (end - options.start) / covered - 1e-3))  # lengths are declared in ms
    return f"{said} of {end:.3f} s: `video: {{every: {every}}}` covers all of it, `max_frames: all` uses all"


def interval_s(header: decode.Header, found: Found) -> float:
    """Seconds between frames."""
    return float(np.median(np.diff(found.times_s))) if len(found.times_s) > 1 else 1 / (header.rate_hz or 25)


def in_words(times_s: list[float]) -> str:
    """Times, the first few of them."""
    return _few([f"{time:.3f}" for time in times_s]) + " s"


def _few(words: list[str], most: int = 8) -> str:
    return ", ".join(words[:most]) + (f" and {len(words) - most} more" if len(words) > most else "")


def _irregular(times_s: Iterable[float]) -> bool:
    """Whether the intervals between frames vary by more than the rounding of time stamps."""
    intervals = np.diff(list(times_s))
    return bool(len(intervals) > 1 and intervals.max() > 1.5 * np.median(intervals))


def _spans(times_s: Iterable[float], gap_s: float) -> Iterator[tuple[float, float]]:
    """Times in runs (first, last), whose steps are at most `gap_s`."""
    ordered = sorted(times_s)
    start = 0
    for k in range(1, len(ordered) + 1):
        if k == len(ordered) or ordered[k] - ordered[k - 1] > gap_s:
            yield ordered[start], ordered[k - 1]
            start = k
