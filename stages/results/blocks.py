"""The lines that pages of figures share with the README, and where they come from."""

from pathlib import Path

from stages.report import provenance
from stages.shared.errors import InputError


def made_by(command: str) -> str:
    """The command, if it is known, the time, the commit and the machine, in one line."""
    about = provenance.about_run()
    commit, _, changed = about["commit"].partition(" ")
    where = f"commit {commit[:12]} {changed}".strip()
    return ", ".join([*([f"`{command}`"] if command else []), about["written"], where, about["machine"]])


def with_block(readme: Path, block: str, marks: tuple[str, str]) -> str:
    """The text of a file with what lies between two marks, and the marks, replaced by the block.

    Raises:
        InputError: if a mark is missing.
    """
    text = readme.read_text()
    before, begin, rest = text.partition(marks[0])
    _, end, after = rest.partition(marks[1])
    if not begin or not end:
        raise InputError(
            readme, f"the lines '{marks[0]}' and '{marks[1]}'", "none", "put them where the summary belongs"
        )
    return before + block + after
