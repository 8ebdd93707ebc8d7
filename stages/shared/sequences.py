"""Find and check image sequences: MPI-Sintel folders, a folder of frame folders, or one folder of frames."""

import difflib
import hashlib
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from PIL import Image, UnidentifiedImageError

from stages.shared.artifacts import read_json
from stages.shared.errors import InputError

SUFFIXES = (".png", ".jpg", ".jpeg")
VIDEO_SUFFIXES = (
    ".mp4",
    ".mov",
    ".m4v",
    ".mkv",
    ".webm",
    ".avi",
    ".mpg",
    ".mpeg",
    ".mts",
    ".m2ts",
    ".ts",
    ".wmv",
    ".3gp",
)
MIN_FRAMES = 3
SMALL_PX = 64
"""Frames whose longer side is less are warned of: it is the least width that the flow can be asked for."""
TRUTH_KINDS = {
    "camdata_left": ".cam",
    "depth": ".dpt",
    "flow": ".flo",
    "motion_mask": ".png",
    "occlusions": ".png",
    "invalid": ".png",
    "clean_right": ".png",
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

    def has_truth(self, kind: str) -> bool:
        """Whether every frame has this kind of truth (flow: every frame but the last)."""
        needed = self.numbers[:-1] if kind == "flow" else self.numbers
        return all(number in self.truth.get(kind, {}) for number in needed)

    def truth_files(self, kind: str) -> list[Path]:
        """The files of a kind of truth that every frame has, in order."""
        return [self.truth[kind][number] for number in self.numbers]


def sequence_folders(dataset: Path, pass_name: str) -> dict[str, Path]:
    """Every sequence of `dataset` with its folder of frames, by name.

    Raises:
        InputError: if the folder or the pass is missing, or nothing in it is a sequence.
    """
    advice = "set `dataset:` to a video, an MPI-Sintel folder, or a folder of frames, of frame folders or of videos"
    if not dataset.is_dir():
        raise InputError(dataset, "a folder or a video", "nothing there", advice)
    if _frame_files(dataset):
        return {folder_name(dataset): dataset}
    training = dataset / "training" if (dataset / "training").is_dir() else dataset
    passes = [name for name in ("clean", "final") if (training / name).is_dir()]
    if passes and pass_name not in passes:
        raise InputError(training, f"the pass '{pass_name}'", f"only {', '.join(passes)}", f"set `pass: {passes[0]}`")
    parent = training / pass_name if passes else dataset
    folders = {folder.name: folder for folder in sorted(parent.iterdir()) if folder.is_dir() and _frame_files(folder)}
    if not folders:
        raise InputError(parent, "folders of PNG or JPG frames, or videos", "none", advice)
    return folders


def video_files(dataset: Path) -> dict[str, Path]:
    """The videos of `dataset`, a video itself or a folder of videos, by name; empty for what holds frames.

    Raises:
        InputError: for a folder with videos and folders of frames, with two videos of one name, or with videos and
            fewer pictures than a sequence needs.
    """
    if dataset.is_file():
        return {dataset.stem: dataset}
    if not dataset.is_dir():
        return {}
    entries, pictures = sorted(dataset.iterdir()), _frame_files(dataset)
    files = [path for path in entries if _is_video(path)]
    if pictures and (len(pictures) >= MIN_FRAMES or not files):
        return {}
    if pictures:
        found = f"'{files[0].name}' and {len(pictures)} picture{'s' * (len(pictures) > 1)}, '{pictures[0].name}'"
        advice = f"move the pictures away, or name the video, as in `dataset: {files[0]}`"
        raise InputError(dataset, f"videos or at least {MIN_FRAMES} frames", found, advice)
    frames = [path for path in entries if path.is_dir() and (path.name == "training" or _frame_files(path))]
    if files and frames:
        advice = f"name the one that you want, as in `dataset: {files[0]}`"
        raise InputError(dataset, "videos or folders of frames", f"'{files[0].name}' and '{frames[0].name}/'", advice)
    videos = {path.stem: path for path in files}
    if len(videos) < len(files):
        twice = next(path for path in files if videos[path.stem] != path)
        raise InputError(twice, "a name of its own", f"'{videos[twice.stem].name}' beside it", "rename one of the two")
    return videos


def folder_name(folder: Path) -> str:
    """The name of a folder of frames; for a symbolic link, the name of the link."""
    return Path(os.path.abspath(folder)).name


def choose(wanted: str | Iterable[str], folders: dict[str, Path], dataset: Path) -> dict[str, Path]:
    """The wanted sequences ("all" or names) of `folders`.

    Raises:
        InputError: for an unknown name, with the nearest known one.
    """
    if wanted == "all":
        return folders
    for name in wanted:
        if name not in folders:
            near = difflib.get_close_matches(name, folders, n=1)
            advice = f"did you mean '{near[0]}'?" if near else f"there are: {', '.join(folders)}"
            raise InputError(dataset, f"a sequence '{name}'", f"{len(folders)} others", advice)
    return {name: folders[name] for name in wanted}


def list_sequence(name: str, folder: Path) -> Sequence:
    """A sequence from the names of its frames and the header of the first one, without truth; no other file is read.

    Raises:
        InputError: for fewer than 3 frames, a gap in the numbering, or an unreadable first frame.
    """
    files = _frame_files(folder)
    if len(files) < MIN_FRAMES:
        raise InputError(
            folder, f"at least {MIN_FRAMES} frames", f"{len(files)}", "add frames or choose another folder"
        )
    numbers = [_number(path) for path in files]
    order = sorted(range(len(files)), key=numbers.__getitem__)
    files, numbers = [files[k] for k in order], [numbers[k] for k in order]
    for before, after, path in zip(numbers, numbers[1:], files[1:], strict=False):
        if after != before + 1:
            found = "the same number twice" if after == before else f"{after} after {before}"
            raise InputError(path, f"frame number {before + 1}", found, "renumber the frames without gaps")
    (width, height), mode = _header(files[0])
    return Sequence(name, files, numbers, width, height, warnings=_conversions({mode}))


def check_sequence(name: str, folder: Path) -> Sequence:
    """Check the frames by their names, headers and last bytes, without decoding, and list the truth beside them.

    Raises:
        InputError: for fewer than 3 frames, a gap in the numbering, different sizes, or an unreadable file.
    """
    sequence = list_sequence(name, folder)
    modes = check_headers(sequence)
    warnings = [*_conversions(modes), *_too_small(sequence), *_unused(folder)]
    return replace(sequence, truth=find_truth(folder), warnings=warnings)


def check_headers(sequence: Sequence) -> set[str]:
    """Check headers and last bytes of all frames, without decoding, and return their Pillow modes.

    Raises:
        InputError: for a size that differs from the first frame's, or an unreadable file.
    """
    modes = set()
    for path in sequence.frames:
        (width, height), mode = _header(path)
        if (width, height) != (sequence.width, sequence.height):
            expected = f"{sequence.width} x {sequence.height} like the first frame"
            raise InputError(path, expected, f"{width} x {height}", "resize the frames")
        modes.add(mode)
    return modes


def frames_digest(frames: list[Path]) -> str:
    """A number that changes when a frame is rewritten: of the names, sizes and times of the files."""
    found = [(path.name, path.stat()) for path in frames]
    content = "".join(f"{name} {of.st_size} {of.st_mtime_ns} " for name, of in found)
    return hashlib.sha1(content.encode(), usedforsecurity=False).hexdigest()[:12]


def truth_folders(folder: Path) -> dict[str, Path]:
    """The existing folders of ground truth, `<training>/<kind>/<sequence>`, for `<training>/<pass>/<sequence>`."""
    if folder.parent.name not in ("clean", "final"):
        return {}
    beside = {kind: folder.parent.parent / kind / folder.name for kind in TRUTH_KINDS}
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


def runs_of(numbers: list[int]) -> list[tuple[int, int]]:
    """The first and the last of every run of ascending numbers without gaps."""
    breaks = [k for k in range(1, len(numbers)) if numbers[k] != numbers[k - 1] + 1]
    starts, stops = [0, *breaks], [*breaks, len(numbers)]
    return [(numbers[start], numbers[stop - 1]) for start, stop in zip(starts, stops, strict=True)] if numbers else []


def number_ranges(numbers: list[int]) -> str:
    """Ascending numbers in words, as "3-5, 8"."""
    return ", ".join(f"{first}-{last}" if last > first else f"{first}" for first, last in runs_of(numbers))


def _frame_files(folder: Path) -> list[Path]:
    with os.scandir(folder) as entries:  # it tells files from folders without a system call for each
        return sorted(folder / entry.name for entry in entries if _is_frame(entry))


def _is_frame(entry: os.DirEntry[str]) -> bool:
    return entry.name.lower().endswith(SUFFIXES) and entry.is_file()


def _is_video(path: Path) -> bool:
    return path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()


def _too_small(sequence: Sequence) -> list[str]:
    size = sequence.width, sequence.height
    said = f"frames of {size[0]} x {size[1]} px show too little: poses and masks need a side of {SMALL_PX} px or more"
    return [said] if max(size) < SMALL_PX else []


def _unused(folder: Path) -> list[str]:
    """That a video beside frames is not used: the frames may be taken from it, or be a cover."""
    videos = sorted(path for path in folder.iterdir() if _is_video(path))
    said = "beside the frames is not used: name it as the `dataset:` if you mean the video"
    return [f"'{videos[0].name}' {said}"] if videos else []


def _number(path: Path) -> int:
    digits = re.findall(r"\d+", path.stem)
    if not digits:
        raise InputError(path, "a frame number in the name, as in frame_0001.png", "none", "rename the frames")
    return int(digits[-1])


def _header(path: Path) -> tuple[tuple[int, int], str]:
    """Size (width, height) and Pillow mode of an image file.

    Raises:
        InputError: if the file is not an image or is truncated.
    """
    try:
        with Image.open(path) as image:
            size, mode = image.size, image.mode
    except (UnidentifiedImageError, OSError, SyntaxError) as error:
        raise InputError(
            path, "a PNG or JPEG image", "something else or a broken header", "replace the file"
        ) from error
    end = b"IEND\xaeB`\x82" if path.suffix.lower() == ".png" else b"\xff\xd9"
    with path.open("rb") as file:
        file.seek(-min(64, path.stat().st_size), 2)
        if end not in file.read():
            raise InputError(path, "a complete image", "one that ends too early", "copy or export the file again")
    return size, mode


def _conversions(modes: set[str]) -> list[str]:
    told = {
        "L": "grey frames are used as RGB with equal channels",
        "1": "black-and-white frames are used as RGB with equal channels",
        "I;16": "16-bit frames are reduced to 8 bits",
        "I": "16-bit frames are reduced to 8 bits",
        "RGBA": "the alpha channel is dropped",
        "LA": "grey frames are used as RGB; the alpha channel is dropped",
        "P": "palette frames are expanded to RGB",
    }
    return sorted(told[mode] for mode in modes if mode in told)
