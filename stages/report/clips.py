"""Sequences that are shots of one clip."""

from pathlib import Path

from stages.shared.artifacts import read_json
from stages.shared.number_ranges import number_ranges


def clip_of(folder: Path) -> str:
    """The name of the clip to which the sequence of a result folder belongs; its own if it is no shot of another."""
    file = folder / "sequence.json"
    content = read_json(file) if file.exists() else {}
    clip = str(content.get("clip", {}).get("name", folder.name))
    return clip if folder.name.startswith(f"{clip}_shot") else folder.name


def shot_lines(folders: list[Path]) -> list[str]:
    """A line for every clip of several shots or of which frames are left out: its sequences with their frames."""
    shots: dict[str, list[str]] = {}
    left_out: dict[str, str] = {}
    for folder in (folder for folder in folders if (folder / "sequence.json").exists()):
        content = read_json(folder / "sequence.json")
        clip = content.get("clip", {"name": content["name"], "left_out": ""})
        if clip["name"] != content["name"] or clip["left_out"]:
            shots.setdefault(clip["name"], []).append(f"{folder.name} (frames {number_ranges(content['numbers'])})")
            left_out[clip["name"]] = f"; {clip['left_out']}" if clip["left_out"] else ""
    return [
        f"{clip}: {len(listed)} shot{'s' * (len(listed) > 1)}, {', '.join(listed)}{left_out[clip]}"
        for clip, listed in shots.items()
    ]
