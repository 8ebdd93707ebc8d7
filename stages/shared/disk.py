"""Disk that a job fills, and whether there is room for all jobs of a run: told before the first one begins.

Coefficients are the largest of the time files (`output_mb`) of 81 runs on scenes and clips of 14 to 200 frames of 512 x
218 and 256 x 108 px, and of the files of the simulator; those of `gaussians` and `viewer` are above what the largest
number of Gaussians takes. Packed flow takes 2.6 to 3.2 bytes per pixel of an edge, and twice that while its blocks are
joined, which is not counted. Decoded frames are PNG files, of which real ones take up to 2.5 bytes per pixel. What is
not listed writes less than a megabyte per hundred frames; `lens`, which writes the flow again only where the lens has
distortion, and `export`, whose formats differ widely, are left out.
"""

import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from stages.shared.errors import InputError
from stages.shared.memory import Held


@dataclass(frozen=True)
class Fill:
    """Disk of a stage: constant megabytes, and bytes per pixel of each kind in `Held`."""

    base_mb: float = 0
    per_edges: float = 0
    per_grid: float = 0
    per_frames: float = 0
    per_frame: float = 0


FILLS = {
    "simulate": Fill(per_frames=20),
    "video": Fill(per_frames=2.5),
    "flow": Fill(per_edges=3.2),
    "motion": Fill(per_grid=6.2),
    "segment": Fill(per_frames=0.33),
    "ba": Fill(per_grid=0.65),
    "control": Fill(per_grid=0.9),
    "gaussians": Fill(30),
    "render": Fill(per_frames=7.5, per_frame=60),
    "viewer": Fill(15),
}


def megabytes_written(stage: str, held: Held) -> int:
    """The megabytes (1e6 bytes) that a job of a stage writes, at least 1."""
    fill = FILLS[stage]
    pixels = fill.per_edges * held.edges + fill.per_grid * held.grid
    pixels += fill.per_frames * held.frames + fill.per_frame * held.frame
    return max(1, round(fill.base_mb + pixels / 1e6))


def told(needed_mb: float, outputs: Sequence[str | Path]) -> str:
    """What the jobs of a run write, and what is free where most of it will lie, in words.

    Args:
        needed_mb: of all jobs. outputs: their files; those that are there from earlier are removed before.

    Raises:
        InputError: if there is less room than the run takes.
    """
    folder = _fullest([Path(output) for output in outputs])
    free_mb = shutil.disk_usage(folder).free / 1e6
    removed_mb = sum(path.stat().st_size for path in map(Path, outputs) if path.is_file()) / 1e6
    taken, free = (f"{mb / 1000:.1f} GB" if mb >= 1000 else f"{mb:.0f} MB" for mb in (needed_mb, free_mb))
    if needed_mb > free_mb + removed_mb:
        advice = "free some, run elsewhere by --directory, or use fewer or smaller frames (max_frames, max_side)"
        raise InputError(folder.resolve(), f"room for the {taken} that this run writes", f"{free} free", advice)
    return f"This run writes about {taken}; {free} are free."


def _fullest(outputs: Sequence[Path]) -> Path:
    """A folder on the disk on which most of the outputs will lie: a folder of results may be a link to another disk."""
    on_disk: Counter[int] = Counter()
    folders: dict[int, Path] = {}
    for folder, count in Counter(output.parent for output in outputs).items():
        existing = next((path for path in (folder, *folder.parents) if path.is_dir()), Path())
        device = existing.stat().st_dev
        on_disk[device] += count
        folders.setdefault(device, existing)
    return folders[on_disk.most_common(1)[0][0]] if folders else Path()
