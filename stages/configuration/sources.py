"""Where the values of the configuration stand, in which file or flag: the first word of a line about a wrong one."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from stages.shared.errors import InputError, OptionError

Source = tuple[str, Mapping[str, Any]]
"""A file or flag, as it is named to the user, and the values that stand there."""


def shown(path: Path) -> str:
    """The name of a file, shorter if it lies in the working folder."""
    return str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)


def named(error: InputError, sources: Iterable[Source]) -> InputError:
    """The error with the file or flag in which the wrong value stands, if it is about an option.

    Args:
        sources: in the order in which they are read: a later one overrides those before it. The values of the first may
            be those of all.
    """
    if not isinstance(error, OptionError):
        return error
    held = {name: _held(values, error.place) for name, values in sources}
    deepest = max(held.values(), default=0)
    if not deepest:
        return error
    return error.standing_in([name for name, depth in held.items() if depth == deepest][-1])


def _held(values: Any, place: Sequence[str]) -> int:
    """How many of the keys that lead to a place are there, up to the first that is not."""
    for depth, key in enumerate(place):
        inside = {str(name): value for name, value in values.items()} if isinstance(values, Mapping) else {}
        if key not in inside:
            return depth
        values = inside[key]
    return len(place)
