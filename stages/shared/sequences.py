"""Image sequences: their frames and the ground truth beside them, listed, checked, written and read."""

import hashlib
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from stages.shared.artifacts import read_json
from stages.shared.dataset_folders import MIN_FRAMES, frame_files, is_video, shown_entries
from stages.shared.errors import InputError
from stages.shared.image_headers import conversions, read_header, refuse_strip

SMALL_PX = 64
"""Frames whose longer side is less are warned of: it is the least that the flow can be asked for."""
TRUTH_KINDS = {
    "camdata_left": ".cam",
    "depth": ".dpt",
    "flow": ".flo",
    "motion_mask": ".png",
    "mover_mask": ".png",
    "occlusions": ".png",
    "invalid": ".png",
    "clean_right": ".png",
    "final_right": ".png",
    "camdata_right": ".cam",
    "distortion": ".json",
}


@dataclass(frozen=True)
class Sequence:
    """One video: its frames in order and the ground truth found beside them.

    Attributes:
        frames: T image files. numbers: [T] the frame numbers in their names. width, height: px.
        truth: kind (a key of TRUTH_KINDS) -> frame number -> file.
        warnings: conversions of the image files, blurred frames, what was found about the video, as sentences.
        times_s: [T] seconds since the first frame of the video; None for a folder of frames, which has no time stamps.
        burnt_in: mask of what is burnt into the frames, 255 where something is; None if nothing is known to be.
    """

    name: str
    frames: list[Path]
    numbers: list[int]
    width: int
    height: int
    truth: dict[str, dict[int, Path]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    times_s: list[float] | None = None
    burnt_in: Path | None = None

    @property
    def stamps(self) -> list[float]:
        """The time stamps [T] of the frames in seconds; their numbers if there are none."""
        return list(self.numbers) if self.times_s is None else self.times_s

    @property
    def right_kind(self) -> str:
        """The kind of the right-eye frames to compare with: of the frames' own pass if there are any, else clean."""
        return "final_right" if self.truth.get("final_right") else "clean_right"

    def has_truth(self, kind: str) -> bool:
        """Whether every frame has this kind of truth (flow: every frame but the last)."""
        needed = self.numbers[:-1] if kind == "flow" else self.numbers
        return all(number in self.truth.get(kind, {}) for number in needed)

    def truth_files(self, kind: str) -> list[Path]:
        """The files of a kind of truth that every frame has, in order."""
        return [self.truth[kind][number] for number in self.numbers]


def list_sequence(name: str, folder: Path) -> Sequence:
    """A sequence from the names of its frames and the header of the first one, without truth; no other file is read.

    Raises:
        InputError: for fewer than 3 frames, a gap in the numbering, a strip, or an unreadable first frame.
    """
    files = frame_files(folder)
    if len(files) < MIN_FRAMES:
        advice = "add frames, choose another folder, or name the others by `sequences: [...]`"
        raise InputError(folder, f"at least {MIN_FRAMES} frames", f"{len(files)}", advice)
    numbers = [_number(path) for path in files]
    order = sorted(range(len(files)), key=numbers.__getitem__)
    files, numbers = [files[k] for k in order], [numbers[k] for k in order]
    for before, after, path in zip(numbers, numbers[1:], files[1:], strict=False):
        if after != before + 1:
            found = "the same number twice" if after == before else f"{after} after {before}"
            advice = "renumber the frames without gaps; the last number in a name counts"
            raise InputError(path, f"frame number {before + 1}", found, advice)
    (width, height), kind = read_header(files[0])
    refuse_strip(files[0], width, height)
    return Sequence(name, files, numbers, width, height, warnings=conversions({kind}))


def check_sequence(name: str, folder: Path) -> Sequence:
    """Check the frames by their names, headers and last bytes, without decoding, and list the truth beside them.

    Raises:
        InputError: for fewer than 3 frames, a gap in the numbering, different sizes, strips, or an unreadable file.
    """
    sequence = list_sequence(name, folder)
    kinds = check_headers(sequence)
    warnings = [*conversions(kinds), *_too_small(sequence), *_unused(folder)]
    return replace(sequence, truth=find_truth(folder), warnings=warnings)


def check_headers(sequence: Sequence) -> set[str]:
    """Check headers and last bytes of all frames, without decoding, and return their kinds (`read_header`).

    Raises:
        InputError: for a size that differs from the first frame's, or an unreadable file.
    """
    kinds = set()
    for path in sequence.frames:
        (width, height), kind = read_header(path)
        if (width, height) != (sequence.width, sequence.height):
            expected = f"{sequence.width} x {sequence.height} like the first frame"
            raise InputError(path, expected, f"{width} x {height}", "resize the frames")
        kinds.add(kind)
    return kinds


def frames_digest(frames: list[Path]) -> str:
    """A number that changes when a frame is rewritten: of the names, sizes and times of the files."""
    found = [(path.name, path.stat()) for path in frames]
    content = "".join(f"{name} {of.st_size} {of.st_mtime_ns} " for name, of in found)
    return hashlib.sha1(content.encode(), usedforsecurity=False).hexdigest()[:12]


def truth_folders(folder: Path) -> dict[str, Path]:
    """The existing folders of ground truth, `<training>/<kind>/<sequence>`, for `<training>/<pass>/<sequence>`."""
    if folder.parent.name not in ("clean", "final"):
        return {}
    foreign = {"clean": "final_right", "final": None}[folder.parent.name]  # of a pass with effects that these lack
    beside = {kind: folder.parent.parent / kind / folder.name for kind in TRUTH_KINDS if kind != foreign}
    return {kind: path for kind, path in beside.items() if path.is_dir()}


def find_truth(folder: Path) -> dict[str, dict[int, Path]]:
    """Files of ground truth for the folder of a sequence's frames, by kind and frame number."""
    return {
        kind: {_number(path): path for path in sorted(beside.glob(f"*{TRUTH_KINDS[kind]}"))}
        for kind, beside in truth_folders(folder).items()
    }


def sequence_to_json(sequence: Sequence) -> dict[str, Any]:
    """The content of `sequence.json`, with absolute paths."""
    truth = {kind: {str(n): str(p.resolve()) for n, p in files.items()} for kind, files in sequence.truth.items()}
    return {
        "name": sequence.name,
        "width": sequence.width,
        "height": sequence.height,
        "numbers": sequence.numbers,
        "frames": [str(path.resolve()) for path in sequence.frames],
        "truth": truth,
        "warnings": sequence.warnings,
        "times_s": sequence.times_s,
        "burnt_in": str(sequence.burnt_in.resolve()) if sequence.burnt_in else None,
    }


def read_sequence(path: Path) -> Sequence:
    """Read `sequence.json`."""
    content = read_json(path)
    truth = {kind: {int(n): Path(p) for n, p in files.items()} for kind, files in content["truth"].items()}
    return Sequence(
        content["name"],
        [Path(frame) for frame in content["frames"]],
        content["numbers"],
        content["width"],
        content["height"],
        truth,
        content["warnings"],
        content.get("times_s"),
        Path(content["burnt_in"]) if content.get("burnt_in") else None,
    )


def _too_small(sequence: Sequence) -> list[str]:
    size = sequence.width, sequence.height
    said = f"frames of {size[0]} x {size[1]} px show too little: poses and masks need a side of {SMALL_PX} px or more"
    return [said] if max(size) < SMALL_PX else []


def _unused(folder: Path) -> list[str]:
    """That a video beside frames is not used: the frames may be taken from it, or be a cover."""
    videos = [path for path in shown_entries(folder) if is_video(path)]
    said = "beside the frames is not used: name it as the `dataset:` if you mean the video"
    return [f"'{videos[0].name}' {said}"] if videos else []


def _number(path: Path) -> int:
    digits = re.findall(r"\d+", path.stem)
    if not digits:
        raise InputError(path, "a frame number in the name, as in frame_0001.png", "none", "rename the frames")
    return int(digits[-1])
