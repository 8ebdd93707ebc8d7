"""What the user hands in for the sequences of a run, checked while the rules are read: files are there, cameras fit."""

import difflib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

from stages.ba.options import BAOptions
from stages.configuration.config import Config, keys_of
from stages.configuration.config import section as section_of
from stages.configuration.datasets import used
from stages.configuration.settings import Setting
from stages.given import depth, flow, masks
from stages.given.cameras_files import find_cameras, read_intrinsics, read_poses, require_lens
from stages.given.files import PLACEHOLDER, of_sequence
from stages.given.intrinsics import ESTIMATE, EXIF, FORMS, TRUTH, parse
from stages.shared.errors import InputError
from stages.shared.options import allowed_words
from stages.shared.sequences import Sequence, frames_digest

Find = Callable[[Path, Sequence], list[Path]]
FINDERS: Mapping[str, Find] = {
    "segment.source": masks.find_masks,
    "segment.evidence": partial(masks.find_masks, option="segment.evidence"),
    "flow.source": flow.find_flow,
    "ba.depth_from": depth.find_depths,
    "ba.poses_from": lambda path, _: find_cameras(path),
    "ba.intrinsics": lambda path, _: find_cameras(path),
}
"""Options whose value may be the path of what the user hands in, with the function that lists its files."""


def given(config: Config, section: str = "") -> dict[str, str]:
    """The paths that options hold, by the option's name, of all sections or of one; words such as "truth" are none."""
    found = {}
    for option in FINDERS:
        if section in ("", option.partition(".")[0]) and (value := _path_in(config, option)):
            found[option] = value
    return found


def check(runs: Iterable[tuple[Setting, Iterable[Sequence]]], videos: Mapping[str, Path] | None = None) -> None:
    """Find the files that the user hands in for the sequences of every setting, and read those of cameras.

    Args:
        videos: of each sequence that is a shot of a video, by name.

    Raises:
        InputError: for a path that does not exist, one path for several sequences, a frame without its file or pose,
            and cameras that cannot be right.
    """
    asked: dict[tuple[str, str], tuple[Setting, dict[str, Sequence]]] = {}
    seen: dict[tuple[str, ...], tuple[Setting, dict[str, Sequence]]] = {}
    for setting, sequences in runs:
        named = {sequence.name: sequence for sequence in sequences}
        for found in given(setting.config).items():
            asked.setdefault(found, (setting, {}))[1].update(named)
        cameras = _adjustment(setting.config)
        key = cameras.intrinsics, cameras.poses_from, cameras.poses_as
        seen.setdefault(key, (setting, {}))[1].update(named)
    for (option, path), (setting, of_name) in asked.items():
        if PLACEHOLDER not in path and not Path(path).exists():
            allowed = _words(setting.config, option)
            near = difflib.get_close_matches(path, allowed, n=1)
            name = ".".join(keys_of(setting.config, option))
            advice = f"did you mean '{near[0]}'?" if near else f"correct '{name}'"
            expected = ", ".join([*allowed, "or a path that exists"]) if allowed else "a path that exists"
            raise setting.error(option, expected, f"'{path}'", advice)
        if PLACEHOLDER not in path and len({_clip(sequence, videos or {}) for sequence in of_name.values()}) > 1:
            expected = f"{PLACEHOLDER} in the path, for the names of {len(of_name)} sequences"
            advice = f"write it where the names differ, as in folder/{PLACEHOLDER}, or choose one of `sequences:`"
            raise setting.error(option, expected, f"'{path}'", advice)
        for sequence in of_name.values():
            FINDERS[option](of_sequence(path, sequence.name), used(setting.config, sequence))
    for setting, of_name in seen.values():
        for sequence in of_name.values():
            _check_cameras(setting, used(setting.config, sequence))


def added_edges(config: Config, sequence: Sequence) -> int:
    """Directed edges of flow that are matched besides those of the options, since the user hands in flow for them."""
    if (path := _path_in(config, "flow.source")) is None:
        return 0
    edges = flow.find_edges(of_sequence(path, sequence.name), sequence)
    return 2 * sum(abs(i - j) not in config.flow.offsets for i, j in edges)


def digest(config: Config, section: str, sequence: Sequence) -> str:
    """What changes when a file is added or rewritten that the user hands in under a section; "" if there is none."""
    paths = [of_sequence(path, sequence.name) for path in given(config, section).values()]
    found = [file for path in paths for file in (sorted(path.iterdir()) if path.is_dir() else [path]) if file.is_file()]
    return frames_digest(found) if found else ""


def _clip(sequence: Sequence, videos: Mapping[str, Path]) -> str:
    """What tells clips apart: the video or folder of the frames, which shots of a clip share; of scenes their name."""
    source = videos.get(sequence.name, sequence.frames[0].parent)
    return sequence.name if source == Path() else str(source)


def _check_cameras(setting: Setting, frames: Sequence) -> None:
    """Read the cameras that the user states for the frames; of EXIF data those of the first, if it is there."""
    options = _adjustment(setting.config)
    seen = options.intrinsics != EXIF or frames.times_s is not None or frames.frames[0].is_file()
    if options.intrinsics not in (ESTIMATE, TRUTH) and seen:
        try:
            read_intrinsics(options.intrinsics, replace(frames, frames=frames.frames[:1]))
        except InputError as error:
            if parse(options.intrinsics).kind not in FORMS:
                raise
            raise setting.error("ba.intrinsics", *error.words) from error
    if _path_in(setting.config, "ba.poses_from"):
        _, Ks = read_poses(options.poses_from, frames, lenses=options.intrinsics == ESTIMATE)
        if options.poses_fixed and options.intrinsics == ESTIMATE:
            require_lens(options.poses_from, Ks)


def _adjustment(config: Config) -> BAOptions:
    options = section_of(config, "ba")
    assert isinstance(options, BAOptions), "the section of ba"
    return options


def _path_in(config: Config, option: str) -> str | None:
    """The path that an option holds; None if it holds a word or numbers, or nothing."""
    name, key = option.split(".")
    value = getattr(section_of(config, name), key)
    if option == "ba.intrinsics":
        return parse(value).path or None
    return None if value is None or value in _words(config, option) else str(value)


def _words(config: Config, option: str) -> list[str]:
    name, key = option.split(".")
    return allowed_words(type(getattr(config, name)).model_fields[key].annotation)
