"""Sizes of the scaling that a sequence does not have: under these options a run would measure another size again."""

from collections.abc import Callable, Iterable, Mapping

from stages.configuration.config import Config
from stages.configuration.settings import Setting
from stages.shared.sequences import Sequence


def _frames(config: Config, sequence: Sequence) -> int:
    """The number of frames that are used."""
    limit, there = config.inspect.max_frames, len(sequence.frames)
    return there if limit == "all" else min(limit, there)


def _side(config: Config, sequence: Sequence) -> int:
    """The longer side of the flow in px."""
    return min(config.flow.max_side_px, max(sequence.width, sequence.height))


KNOWN: Mapping[str, Callable[[Config, Sequence], int]] = {"inspect.max_frames": _frames, "flow.max_side_px": _side}
"""Options whose effect on a sequence is known before any job, and the size that they give it."""


def distinct(configured: Setting, listed: Iterable[Setting], sequence: Sequence) -> tuple[list[Setting], list[str]]:
    """The settings of the scaling that differ in size on a sequence, and a line per option about those that do not.

    The configured run stays, and of other settings of one size the first.
    """
    kept: list[Setting] = []
    again: dict[str, list[str]] = {}
    seen = {option: {size(configured.config, sequence)} for option, size in KNOWN.items()}
    for setting in listed:
        option = setting.knob or ""
        if option not in KNOWN or setting.config == configured.config:
            kept.append(setting)
            continue
        size = KNOWN[option](setting.config, sequence)
        if size in seen[option]:
            again.setdefault(option, []).append(str(setting.value))
        else:
            kept.append(setting)
        seen[option].add(size)
    return kept, [_told(sequence, option, values) for option, values in again.items()]


def _told(sequence: Sequence, option: str, values: list[str]) -> str:
    size = f"{sequence.width} x {sequence.height} px"
    there = f"has {len(sequence.frames)} frames" if KNOWN[option] is _frames else f"is of {size}"
    return f"scaling: {sequence.name} {there}: {option} {', '.join(values)} would measure the same again; left out"
