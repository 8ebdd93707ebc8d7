"""The exception for wrong input, as opposed to an error of the program."""

import contextlib
from collections.abc import Iterator
from pathlib import Path


class InputError(Exception):
    """Bad input, described in one line: subject, expected, found, advice. It ends a stage with exit code 2.

    Args:
        subject: the file, folder or option that is wrong.
        expected: a correct value, e.g. "a float32 tag 202021.25".
        found: the value found.
        advice: the next step for the user.
    """

    def __init__(self, subject: Path | str, expected: str, found: str, advice: str) -> None:
        self.subject = str(subject)
        super().__init__(f"{subject}: expected {expected}, found {found}; {advice}")


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
