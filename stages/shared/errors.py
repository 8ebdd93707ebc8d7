"""The exception for wrong input, as opposed to an error of the program."""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path

THE_CONFIGURATION = "the configuration"
"""Where a wrong value stands if it is not known in which file or flag."""


class InputError(Exception):
    """Bad input, described in one line: subject, expected, found, advice. It ends a stage with exit code 2.

    Args:
        subject: the file, folder or option that is wrong.
        expected: a correct value, e.g. "a float32 tag 202021.25".
        found: the value found.
        advice: the next step for the user.
    """

    def __init__(self, subject: Path | str, expected: str, found: str, advice: str) -> None:
        self.subject, self.words = str(subject), (expected, found, advice)
        super().__init__(f"{subject}: expected {expected}, found {found}; {advice}")


class OptionError(InputError):
    """A wrong value of an option. In which file or flag it stands is known to who reads these: `standing_in` says so.

    Args:
        place: the keys that lead to the value, as in ("ba", "zoom").
        expected, found, advice: as in InputError.
        where: file or flag in which it stands. name: what is said after that; "": the keys, joined by dots.
    """

    def __init__(
        self,
        place: Sequence[str],
        expected: str,
        found: str,
        advice: str,
        where: str = THE_CONFIGURATION,
        name: str = "",
    ) -> None:
        self.place, self.name = tuple(place), name or ".".join(place)
        super().__init__(f"{where}: {self.name}", expected, found, advice)

    def standing_in(self, where: str) -> "OptionError":
        """The same, with the file or flag in which the value stands."""
        return OptionError(self.place, *self.words, where, self.name)

    def of_setting(self, place: Sequence[str], setting: str) -> "OptionError":
        """The same of a setting of a comparison, to whose options the keys `place` lead."""
        return OptionError(place, *self.words, name=f"{setting}: {self.name}")


@contextlib.contextmanager
def complete(path: Path, expected: str, advice: str) -> Iterator[None]:
    """Turn a missing key into an InputError while columns or keys of `path` are looked up.

    Args:
        expected, advice: as in InputError. The file may come from another program, so this is not a bug.
    """
    try:
        yield
    except KeyError as missing:
        raise InputError(path, expected, f"no {missing}", advice) from missing
