"""What a dataset holds: MPI-Sintel folders, a folder of frame folders or of videos, one folder of frames, a video."""

import difflib
import os
from collections.abc import Iterable
from pathlib import Path

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


def sequence_folders(dataset: Path, pass_name: str) -> dict[str, Path]:
    """Every sequence of `dataset` with its folder of frames, by name.

    Raises:
        InputError: if the folder or the pass is missing, or nothing in it is a sequence.
    """
    advice = "set `dataset:` to a video, an MPI-Sintel folder, or a folder of frames, of frame folders or of videos"
    if not dataset.is_dir():
        raise InputError(dataset, "a folder or a video", "nothing there", advice)
    if frame_files(dataset):
        return {folder_name(dataset): dataset}
    training = dataset / "training" if (dataset / "training").is_dir() else dataset
    passes = [name for name in ("clean", "final") if (training / name).is_dir()]
    if passes and pass_name not in passes:
        raise InputError(training, f"the pass '{pass_name}'", f"only {', '.join(passes)}", f"set `pass: {passes[0]}`")
    parent = training / pass_name if passes else dataset
    folders = {entry.name: entry for entry in shown_entries(parent) if entry.is_dir() and frame_files(entry)}
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
    entries, pictures = shown_entries(dataset), frame_files(dataset)
    files = [path for path in entries if is_video(path)]
    if pictures and (len(pictures) >= MIN_FRAMES or not files):
        return {}
    if pictures:
        found = f"'{files[0].name}' and {len(pictures)} picture{'s' * (len(pictures) > 1)}, '{pictures[0].name}'"
        advice = f"move the pictures away, or name the video, as in `dataset: {files[0]}`"
        raise InputError(dataset, f"videos or at least {MIN_FRAMES} frames", found, advice)
    frames = [path for path in entries if path.is_dir() and (path.name == "training" or frame_files(path))]
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


def frame_files(folder: Path) -> list[Path]:
    """The PNG and JPEG files of a folder, by name."""
    with os.scandir(folder) as entries:  # it tells files from folders without a system call for each
        return sorted(folder / entry.name for entry in entries if _is_frame(entry))


def _is_frame(entry: os.DirEntry[str]) -> bool:
    return entry.name.lower().endswith(SUFFIXES) and not _is_hidden(entry.name) and entry.is_file()


def _is_hidden(name: str) -> bool:
    """Whether a file or folder is hidden, as `._frame_0001.png` is, which macOS writes beside a file on a stick."""
    return name.startswith(".")


def shown_entries(folder: Path) -> list[Path]:
    """What is in a folder, by name, without what is hidden."""
    return sorted(entry for entry in folder.iterdir() if not _is_hidden(entry.name))


def is_video(path: Path) -> bool:
    """Whether a file is named like a video."""
    return path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()
