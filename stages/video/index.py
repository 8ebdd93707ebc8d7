"""What a video holds, found by decoding it once: its shots, the frames to use of each, and what is wrong with it.

The workflow needs names, sizes and numbers of frames of all sequences before it plans a job, and a cut makes two
sequences of one video. Hence the video is looked through while the rules are read. What is found is kept in a file,
named by all that it depends on: later runs find it there, and so do jobs on a cluster, which read the rules again. A
checkpoint, the other way, would plan every rule twice; `snakemake -n`, memory and names would wait for the decoding.
"""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

from stages.shared.artifacts import read_json, write_json
from stages.shared.bars import BrightestYet
from stages.shared.dataset_folders import MIN_FRAMES
from stages.shared.digest import code_digest
from stages.shared.errors import InputError
from stages.shared.image_headers import refuse_strip
from stages.shared.images import reduce, reduced_size
from stages.shared.log import progress
from stages.video import decode, findings
from stages.video.options import VideoOptions
from stages.video.shots import Found, Look, Shot, find_shots

LOOK_SIDE_PX = 512


@dataclass(frozen=True)
class Index:
    """What a video holds.

    Attributes:
        shots: name of a sequence -> its frames. width, height: of the frames as written, px.
        bars_px: black bars cut off the frames as coded: left and right alike, above and below alike.
        findings: codec, rotation, frame rate, repeated frames, cuts, ... by name. warnings: for the user, as sentences.
    """

    shots: dict[str, Shot]
    width: int
    height: int
    bars_px: tuple[int, int]
    findings: dict[str, Any]
    warnings: list[str] = field(default_factory=list)


def load_index(video: Path, options: VideoOptions, cache: Path | None = None, cuts: bool = True) -> Index:
    """The index of a video, from the folder `cache` if it is there and still true, else made and kept there.

    Args:
        cuts: whether to look for cuts; else the video is one shot.

    Raises:
        InputError: as `make_index`.
    """
    file = cache and cache / f"{video.stem}-{_key(video, options, cuts)}.json"
    if file and file.is_file():
        content = read_json(file)
        content.pop("format_version")
        shots = {name: Shot(**shot) for name, shot in content.pop("shots").items()}
        return Index(shots=shots, bars_px=tuple(content.pop("bars_px")), **content)
    index = make_index(video, options, cuts)
    if file:
        write_json(file, asdict(index))
    return index


def make_index(video: Path, options: VideoOptions, cuts: bool = True) -> Index:
    """Look through a video, for its cuts too if `cuts`.

    Raises:
        InputError: for a file that is no video, is incomplete, ends before `start`, changes the size of its frames, or
            has too few frames that differ.
    """
    header = decode.read_header(video)
    first: list[decode.Frame] = []
    interlaced: list[float] = []
    unordered: list[Fraction | None] = []
    brightest = BrightestYet()

    def looks() -> Iterator[Look]:
        before_s = 0.0
        for frame in decode.read_frames(video, options.start, options.end, unordered):
            if not first:
                first.append(frame)
            _refuse_other_size(video, first[0], frame, before_s)
            before_s = frame.time_s
            if frame.interlaced:
                interlaced.append(frame.time_s)
            coded = decode.grey(frame)
            brightest.see(coded)
            yield Look(
                frame.pts, frame.time_s, reduce(coded, reduced_size(coded.shape[1], coded.shape[0], LOOK_SIDE_PX))
            )

    expected = _expected_frames(header, options)
    limit = None if options.max_frames == "all" else options.max_frames
    found = find_shots(progress(looks(), f"reading {video.name}", expected), options.every, limit, cuts)
    _refuse_incomplete(video, header, options, found)
    bars_px = brightest.bars_px()
    width, height = decode.upright_size(first[0], header, bars_px, options.max_side)
    refuse_strip(video, width, height)
    return Index(
        shots=_named(video.stem, found.shots),
        width=width,
        height=height,
        bars_px=bars_px,
        findings=findings.describe(video, header, first[0], found, bool(interlaced)),
        warnings=findings.of_bars(bars_px)
        + findings.of_order(len(unordered))
        + findings.of_frames(header, first[0], found, options, bool(interlaced)),
    )


def _named(stem: str, shots: list[Shot]) -> dict[str, Shot]:
    """Shots by the names of their sequences: that of the video, with a number if there are several."""
    return {stem: shots[0]} if len(shots) == 1 else {f"{stem}_shot{k}": shot for k, shot in enumerate(shots, start=1)}


def _refuse_other_size(video: Path, first: decode.Frame, frame: decode.Frame, before_s: float) -> None:
    """Refuse a frame of another size than the first one, as joined recordings and calls have them."""
    size, other = (f"{one.image.width} x {one.image.height} px" for one in (first, frame))
    if size != other:
        advice = f"export it at one size, or use the part before by {decode.end_option(before_s)}"
        raise InputError(video, f"frames of {size} like the first", f"{other} at {frame.time_s:.3f} s", advice)


def _refuse_incomplete(video: Path, header: decode.Header, options: VideoOptions, found: Found) -> None:
    if not found.times_s:
        length = f"{header.length_s:.3f} s" if header.length_s else "no frames"
        if options.start > 0:
            until = "" if options.end is None else f" and until `end`, {options.end:g} s"
            advice = "set `video: {start: ...}` to an earlier time" + (until and ", or `end` to a later one")
            expected = f"frames after `start`, {options.start:g} s{until}"
            raise InputError(video, expected, f"none in a video of {length}", advice)
        raise InputError(video, f"at least {MIN_FRAMES} frames", "none that can be decoded", "export the video again")
    last_s, interval_s = found.times_s[-1], findings.interval_s(header, found)
    wanted = options.end is None or options.end > last_s + 2 * interval_s
    if wanted and found.complete and decode.is_cut_short(header, last_s, interval_s):
        advice = f"copy or export the video again, or use what there is by {decode.end_option(last_s)}"
        raise InputError(video, f"{header.length_s:.3f} s, as its header says", f"{last_s + interval_s:.3f} s", advice)
    if not found.shots:
        total = len(found.times_s)
        used = f", one in {options.every} used" if options.every > 1 else ""
        less = f" ({len(found.duplicates_s)} of them repeat others)" if found.duplicates_s else ""
        cut = f" with cuts at {findings.in_words(found.cuts_s)}" if found.cuts_s else ""
        advice = "give a longer part" + (", or a smaller `video: {every: ...}`" if options.every > 1 else "")
        advice += ", or `shots: no` if nothing is cut there" if found.cuts_s else ""
        expected = f"at least {MIN_FRAMES} frames that differ, without a cut between them"
        raise InputError(video, expected, f"{total} frame{'s' * (total != 1)}{used}{less}{cut}", advice)


def _expected_frames(header: decode.Header, options: VideoOptions) -> int:
    """About as many frames as will be looked at, for the progress bar."""
    length_s, rate_hz = header.length_s or 0, header.rate_hz or 25
    count = rate_hz * max(0, min(options.end or length_s, length_s) - options.start)
    wanted = count if options.max_frames == "all" else options.every * options.max_frames
    return int(min(count, wanted)) or 1


def _key(video: Path, options: VideoOptions, cuts: bool) -> str:
    """A digest of all that an index depends on: the file, by its size and time, the options and the code."""
    status = video.stat()
    about = [
        str(video.resolve()),
        status.st_size,
        status.st_mtime_ns,
        options.model_dump(),
        cuts,
        code_digest(__name__),
    ]
    return hashlib.sha256(json.dumps(about).encode()).hexdigest()[:12]
