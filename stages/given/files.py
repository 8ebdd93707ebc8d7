"""Files that the user hands in: where they lie for a sequence, and to which frame each of them belongs."""

import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated

from pydantic import Field

from stages.shared.dataset_folders import shown_entries
from stages.shared.errors import InputError

GivenPath = Annotated[str, Field(min_length=1)]
"""The type of an option that holds a path: an empty one would count as none."""
PLACEHOLDER = "{sequence}"
"""Stands in a path for the name of the sequence."""
CONFIDENCE = ".confidence"
"""Ends the stem of a file of confidences: frame_0001.confidence.npy belongs to frame_0001.dpt."""


def of_sequence(path: str, name: str) -> Path:
    """The path for the sequence of this name."""
    return Path(path.replace(PLACEHOLDER, name))


def listed(folder: Path, suffixes: Iterable[str], what: str, option: str) -> list[Path]:
    """The files of a folder with one of the suffixes, in order of names, without those of confidences.

    Args:
        what: the files in words, as in "masks"; option: that names the folder, as in "segment.source".

    Raises:
        InputError: if the folder is missing or holds no such file.
    """
    kinds = tuple(suffixes)
    expected = f"a folder of {what} ({', '.join(kinds)}) for `{option}`"
    if not folder.is_dir():
        raise InputError(folder, expected, "a file" if folder.exists() else "nothing there", f"correct `{option}`")
    found = [path for path in shown_entries(folder) if path.suffix.lower() in kinds and path.is_file()]
    found = [path for path in found if not path.stem.endswith(CONFIDENCE)]
    if not found:
        raise InputError(folder, expected, "none of them", f"correct `{option}`")
    return found


def by_frame(files: Sequence[Path], frames: Sequence[Path], numbers: Sequence[int], what: str) -> list[Path]:
    """The file of every frame [T], by its name (`frame_0001.png`, COLMAP's `frame_0001.png.png`), else by its number.

    Args:
        files: candidates, all in one folder. frames, numbers: [T] the frames and the numbers in their names.
        what: the files in words.

    Raises:
        InputError: if a frame has no file, or two.
    """
    suffix = frames[0].suffix
    wanted: list[str | int] = [frame.stem for frame in frames]
    found = _grouped(files, lambda path: stem_of(path, suffix))
    if not set(wanted) & set(found):
        wanted, found = list(numbers), _grouped(files, _number_or_name)
    missing = [frame for frame, key in zip(frames, wanted, strict=True) if key not in found]
    folder = files[0].parent
    if missing:
        there = f"{len(frames) - len(missing)} of {len(frames)}, and none for '{missing[0].name}'"
        raise InputError(folder, f"{what} for every frame", there, "name files like the frames, or by their numbers")
    for key in wanted:
        if len(found[key]) > 1:
            first, second = found[key][:2]
            raise InputError(folder, f"one file of {what} per frame", f"'{first.name}', '{second.name}'", "keep one")
    return [found[key][0] for key in wanted]


def stem_of(path: Path, suffix: str) -> str:
    """The name of a file without its suffix, and without that of the frames if COLMAP's naming keeps it."""
    return path.stem.removesuffix(suffix)


def is_colmap_named(path: Path, suffix: str) -> bool:
    """Whether a file is named as COLMAP names masks: the name of the frame, with its suffix, and .png."""
    return path.stem.lower().endswith(suffix.lower())


def confidence_file(path: Path) -> Path | None:
    """The file of confidences beside a file, <name>.confidence.npy or .png; None without one."""
    beside = (path.with_name(f"{path.stem}{CONFIDENCE}{suffix}") for suffix in (".npy", ".png"))
    return next((candidate for candidate in beside if candidate.is_file()), None)


def numbers_in(stem: str) -> list[int]:
    """All whole numbers in a name, in order."""
    return [int(digits) for digits in re.findall(r"\d+", stem)]


def _number_or_name(path: Path) -> str | int:
    numbers = numbers_in(path.stem)
    return numbers[-1] if numbers else path.stem


def _grouped(files: Iterable[Path], key: Callable[[Path], str | int]) -> dict[str | int, list[Path]]:
    found: dict[str | int, list[Path]] = {}
    for path in files:
        found.setdefault(key(path), []).append(path)
    return found
