"""The pages of the viewer: within the report as long as it can still be mailed, and as links to the files beside it."""

import json
import os
import urllib.parse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import markupsafe

from stages.report.sections import Section

ROOM_BYTES = 14_000_000
"""Scenes are taken in while the report with its figures stays below this: most mail servers take 20 MB and more."""
REST_BYTES = 1_000_000
"""What a report holds besides the figures of its sequences."""


@dataclass(frozen=True)
class ScenePage:
    """The 4D scene of a sequence.

    Attributes:
        link: the page, relative to the report. content: the page as a JSON string, "" where the report has no room.
    """

    name: str
    link: str
    megabytes: float
    content: str


def find_scene_pages(folders: Sequence[Path], sections: Sequence[Section], output: Path) -> list[ScenePage]:
    """The pages of the result folders that have one, in order; the first ones, as far as there is room, with content.

    Args:
        sections: of the sequences, with their figures. output: the report, to which links are relative.
    """
    figures = (figure for section in sections for figure in [*section.figures, *section.stage_figures])
    used, found = REST_BYTES + sum(len(figure.source) for figure in figures), []
    for folder in folders:
        path = folder / "gaussians" / "scene.html"
        if not path.exists():
            continue
        content = json.dumps(path.read_text(encoding="utf-8"), ensure_ascii=False).replace("<", "\\u003c")
        size = len(content.encode())
        inside = used + size <= ROOM_BYTES
        used += size if inside else 0
        link = urllib.parse.quote(os.path.relpath(path, output.parent))
        shown = markupsafe.Markup(content) if inside else ""
        found.append(ScenePage(folder.name, link, path.stat().st_size / 1e6, shown))
    return found
