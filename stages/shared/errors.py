"""The one exception that means: the input is wrong, not the program."""

import contextlib
from collections.abc import Iterator
from pathlib import Path


class InputError(Exception):
    """Bad input, told in one line: what, expected, found, what to do. Ends a stage with exit code 2.

    Args:
        subject: file, folder or option that is wrong.
        expected: what would have been right, e.g. "a float32 tag 202021.25".
        found: what is there instead.
        advice: the next step for the user.
    """

    def __init__(self, subject: Path | str, expected: str, found: str, advice: str) -> None:
        self.subject = str(subject)
        super().__init__(f"{subject}: expected {expected}, found {found}; {advice}")


@contextlib.contextmanager
def complete(path: Path, expected: str, advice: str) -> Iterator[None]:
    """While columns or keys of `path` are looked up: one that a file of foreign origin lacks is bad input, no bug."""
    try:
        yield
    except KeyError as missing:
        raise InputError(path, expected, f"no {missing}", advice) from missing
