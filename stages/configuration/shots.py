"""The shots of clips: those that the user states, or those between the cuts that are found. Each is a sequence."""

import difflib
import itertools
import re
from collections.abc import Iterable, Mapping, Sized
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from stages.shared.dataset_folders import MIN_FRAMES, choose
from stages.shared.errors import OptionError
from stages.shared.number_ranges import number_ranges
from stages.shared.sequences import Sequence

Range = tuple[int, int]
"""Numbers of the first and the last frame of a shot."""
Stated = Literal["auto", "no"] | list[Range]
"""The shots of a clip: find the cuts, do not look for them, or the shots themselves, by their frames."""
WORDS = ("auto", "no")
EXAMPLE = "[[1, 40], [41, 90]]"


@dataclass(frozen=True)
class Part:
    """A sequence that is a part of a folder of frames.

    Attributes:
        clip: name of the whole folder's sequence. first, last: frame numbers.
        left_out: what is in no shot of the clip, in words, or "".
    """

    clip: str
    first: int
    last: int
    left_out: str = ""


def read_option(value: Any) -> Any:
    """The value of the option `shots` with words for booleans and pairs of numbers.

    Raises:
        ValueError: for what is neither a word nor a list of shots, one after the other, nor one of these by clip.
    """
    if isinstance(value, Mapping):
        return {str(clip): _read_stated(stated) for clip, stated in value.items()}
    return _read_stated(value)


def check_names(option: Stated | dict[str, Stated], clips: Iterable[str]) -> None:
    """Check that the option names clips of the dataset alone; raises OptionError."""
    known = list(clips)
    for name in option if isinstance(option, dict) else ():
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            advice = f"did you mean '{near[0]}'?" if near else f"there are: {', '.join(known)}"
            raise OptionError(["shots"], "names of clips of the dataset", f"'{name}'", advice)


def of_clip(option: Stated | dict[str, Stated], clip: str, clips: Sized) -> Stated:
    """What the option says of one of the chosen clips.

    Raises:
        OptionError: for one list of shots where there are several clips.
    """
    if isinstance(option, dict):
        return option.get(clip, "auto")
    if isinstance(option, list) and len(clips) > 1:
        advice = f"write `shots: {{{clip}: {EXAMPLE}}}`, or choose one of `sequences:`"
        raise OptionError(["shots"], f"shots by name for {len(clips)} clips", "one list of shots", advice)
    return option


def names_of(clip: str, count: int) -> list[str]:
    """The names of the sequences that a clip of `count` shots makes: its own if there is one shot."""
    return [clip] if count == 1 else [f"{clip}_shot{k}" for k in range(1, count + 1)]


def clip_of(name: str, clips: Iterable[str]) -> str:
    """The clip, out of `clips`, to which a sequence of this name belongs or would belong; else the name itself."""
    shot = re.fullmatch(r"(.+)_shot\d+", name)
    known = set(clips)
    return shot[1] if shot and name not in known and shot[1] in known else name


def check_ranges(ranges: list[Range], first: int, last: int, clip: str) -> None:
    """Check that shots lie within the frames `first` to `last` of a clip; raises OptionError."""
    for a, b in ranges:
        if a < first or b > last:
            advice = "correct `shots`: they count the frames as they are numbered without cuts"
            raise OptionError(["shots"], f"frames {first} to {last} of {clip}", f"[{a}, {b}]", advice)


def divided(
    whole: Mapping[str, Sequence], option: Stated | dict[str, Stated], wanted: str | list[str], kept: Path | None
) -> tuple[dict[str, Sequence], dict[str, Part]]:
    """The sequences of folders of frames, each shot one of its own, and which part of its folder each is.

    A folder that is one shot is no part.

    Args:
        whole: every folder of frames. option: `shots`. wanted: `sequences`, names of folders or of shots, or "all".
        kept: folder in which the cuts that are found are kept; None: they are not looked for.

    Raises:
        InputError: for an unknown name, or frames that a clip does not have.
    """
    sequences: dict[str, Sequence] = {}
    parts: dict[str, Part] = {}
    chosen: dict[str, list[str]] = {}
    for clip, sequence in whole.items():
        ranges, left_out = _ranges(sequence, of_clip(option, clip, whole), kept)
        chosen[clip] = names_of(clip, len(ranges))
        for name, (first, last) in zip(chosen[clip], ranges, strict=True):
            sequences[name] = _cut(sequence, name, first, last)
            if (first, last) != (sequence.numbers[0], sequence.numbers[-1]):
                parts[name] = Part(clip, first, last, left_out)
    if isinstance(wanted, str):
        return sequences, parts
    names = dict.fromkeys(shot for name in wanted for shot in chosen.get(name, [name]))
    folder = next(iter(whole.values())).frames[0].parent.parent
    choose(names, dict.fromkeys(sequences, folder), folder)
    return {name: sequences[name] for name in names}, parts


def _ranges(sequence: Sequence, stated: Stated, kept: Path | None) -> tuple[list[Range], str]:
    """The shots of a clip, and what is in none of them, in words."""
    first, last = sequence.numbers[0], sequence.numbers[-1]
    if isinstance(stated, list):
        check_ranges(stated, first, last, sequence.name)
        return stated, ""
    if stated == "no" or kept is None:
        return [(first, last)], ""
    from stages.video.folders import load_ranges

    ranges = load_ranges(sequence, kept)
    left = set(sequence.numbers).difference(*(range(a, b + 1) for a, b in ranges))
    if not left:
        return ranges, ""
    return ranges, f"frames {number_ranges(sorted(left))} are left out: fewer than {MIN_FRAMES} between cuts, or blank"


def _cut(sequence: Sequence, name: str, first: int, last: int) -> Sequence:
    """The frames `first` to `last` of a sequence, under a name of their own."""
    inside = slice(first - sequence.numbers[0], last - sequence.numbers[0] + 1)
    return replace(sequence, name=name, frames=sequence.frames[inside], numbers=sequence.numbers[inside])


def _read_stated(value: Any) -> Any:
    if isinstance(value, bool) and not value:
        return "no"  # YAML 1.1 reads an unquoted no as false
    if value in WORDS:
        return value
    wrong = ValueError(
        f"auto, no, or shots of at least {MIN_FRAMES} frames one after the other, by their first and last frame, as in "
        f"{EXAMPLE}, or one of these for each clip by its name"
    )
    try:
        ranges = [(int(first), int(last)) for first, last in value]
    except (TypeError, ValueError):
        raise wrong from None
    if not ranges or any(last - first + 1 < MIN_FRAMES for first, last in ranges):
        raise wrong
    if any(after[0] <= before[1] for before, after in itertools.pairwise(ranges)):
        raise wrong
    return ranges
