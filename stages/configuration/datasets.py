"""The sequences of the chosen dataset: folders of frames, shots of videos, or scenes that the simulator will render."""

import functools
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from stages.configuration import shots as clip_shots
from stages.configuration.config import SIMULATED, Config
from stages.shared.dataset_folders import choose, sequence_folders, video_files
from stages.shared.errors import InputError
from stages.shared.sequences import Sequence, check_headers, list_sequence

if TYPE_CHECKING:
    from stages.simulate.scene import Scene
    from stages.video.index import Index
    from stages.video.shots import Shot

SCENES = Path(__file__).parents[1] / "simulate" / "scenes"
"""The scene library; its folder `long` holds scenes of a thousand frames, which run only by their names."""
MARKS = "{}<>"
"""Begin and end wildcards and variables in the paths of the workflow."""
EARLY_FRAMES = 1000
"""Up to this many frames, all image headers are checked before any work; beyond, those of each first frame alone.

Thousands of headers take seconds, and minutes on the file systems of clusters. `inspect` checks all of them.
"""


def dataset_name(config: Config) -> str:
    """The folder name under results/."""
    if config.dataset == SIMULATED:
        return SIMULATED
    dataset = Path(config.dataset).resolve()
    return dataset.stem if dataset.is_file() else dataset.name


def require_folders(config: Config) -> None:
    """Refuse a file where a run makes its folders, and folders that are read-only: Snakemake ends in a traceback there.

    Raises:
        InputError: names the file or folder.
    """
    for parent in ("results", "logs", SIMULATED if config.dataset == SIMULATED else "decoded"):
        for path in (Path(parent), Path(parent, dataset_name(config))):
            if (path.is_symlink() or path.exists()) and not path.is_dir():
                found = "a file" if path.exists() else "a link to nothing"
                raise InputError(path, "a folder", found, "move it, or run elsewhere by --directory")
            where = next((folder for folder in (path, *path.parents) if folder.exists()), Path())
            if not os.access(where, os.W_OK):
                advice = "make it writable, or run elsewhere by --directory"
                raise InputError(where.resolve(), "a folder to write to", "one that is read-only", advice)


def find_sequences(
    config: Config, folders: Mapping[str, str], shots: Mapping[str, "VideoShot"], headers: bool = True
) -> dict[str, Sequence]:
    """The chosen sequences with frames and sizes, without truth.

    Those of simulated sequences are taken from scene files, those of videos from their indexes.

    Args:
        folders: the folder of frames of every chosen sequence. shots: `video_shots`.
        headers: check the headers of all frames if there are at most EARLY_FRAMES of them.

    Raises:
        InputError: for too few frames, gaps in their numbers and unreadable frames.
    """
    if config.dataset == SIMULATED:
        scenes = scene_files(config)
        return {name: _promised(name, scenes[name]) for name in folders}
    if shots:
        return {name: _decoded(name, Path(folders[name]), shots[name]) for name in folders}
    sequences = {name: list_sequence(name, Path(folder)) for name, folder in folders.items()}
    if headers and sum(len(sequence.frames) for sequence in sequences.values()) <= EARLY_FRAMES:
        for sequence in sequences.values():
            check_headers(sequence)
    return sequences


def divided(
    config: Config, sequences: Mapping[str, Sequence], shots: Mapping[str, "VideoShot"]
) -> tuple[dict[str, Sequence], dict[str, clip_shots.Part]]:
    """The sequences, where a folder of frames holds several shots those of each, and what each is a part of.

    Cuts are looked for in folders of frames that exist: scenes have none.

    Raises:
        InputError: for an unknown sequence, or stated shots outside of their clip.
    """
    if shots:
        return dict(sequences), {}
    kept = None if config.dataset == SIMULATED else decoded_folder(config) / ".index"
    return clip_shots.divided(sequences, config.shots, config.sequences, kept)


def frame_folders(config: Config, shots: Mapping[str, "VideoShot"]) -> dict[str, str]:
    """The folder of frames of every chosen clip, and of every shot of a video.

    Those of scenes are under simulated/, those of videos under decoded/.

    Args:
        shots: `video_shots`, which reads the indexes of all videos.

    Raises:
        InputError: for an unknown sequence, or a name with one of MARKS.
    """
    dataset = Path(config.dataset)
    if config.dataset == SIMULATED:
        folders = {name: Path(SIMULATED, "training", config.pass_, name) for name in scene_files(config)}
    elif shots:
        folders = {name: decoded_folder(config) / name for name in shots}
    else:
        folders = sequence_folders(dataset, config.pass_)
    if not shots:
        clip_shots.check_names(config.shots, folders)
    wanted = config.sequences if config.sequences == "all" else _wanted(config.sequences, folders, shots)
    chosen = {name: str(folder) for name, folder in choose(wanted, folders, dataset).items()}
    for name in (dataset_name(config), *chosen):
        if set(MARKS) & set(name):
            raise InputError(dataset, f"names without {' '.join(MARKS)}", f"'{name}'", "rename the file or folder")
    return chosen


def _wanted(names: list[str], folders: Mapping[str, Path], shots: Mapping[str, "VideoShot"]) -> list[str]:
    """The names of folders of frames for chosen sequences: all shots of a named video, the folder of a named shot."""
    of_video = {name: [shot for shot, of in shots.items() if of.video.stem == name] for name in names}
    listed = (of_video[name] or [clip_shots.clip_of(name, folders)] for name in names)
    return list(dict.fromkeys(folder for some in listed for folder in some))


@dataclass(frozen=True)
class VideoShot:
    """A sequence of a video.

    Attributes:
        index: of the whole video. shot: the frames of the sequence. flags: with which the script decodes them.
    """

    video: Path
    index: "Index"
    shot: "Shot"
    flags: str


def video_shots(config: Config) -> dict[str, VideoShot]:
    """The sequences of the dataset's videos, by name; empty if it is no video. Each video is looked through once.

    Raises:
        InputError: for a video that cannot be used.
    """
    videos = {} if config.dataset == SIMULATED else video_files(Path(config.dataset))
    if not videos:
        return {}
    kept = decoded_folder(config) / ".index"
    clip_shots.check_names(config.shots, videos)
    if config.sequences != "all":
        names = config.sequences
        named = [stem for stem in videos if any(name == stem or name.startswith(f"{stem}_shot") for name in names)]
        videos = {stem: videos[stem] for stem in named} or videos  # an unknown name is told from all that there are
    shots: dict[str, VideoShot] = {}
    for clip, video in videos.items():
        for name, shot in _shots_of(video, clip_shots.of_clip(config.shots, clip, videos), config, kept).items():
            if name in shots:
                raise InputError(video, "a name of its own", f"a shot '{name}' of {shots[name].video}", "rename one")
            shots[name] = shot
    return shots


def _shots_of(video: Path, stated: clip_shots.Stated, config: Config, kept: Path) -> dict[str, VideoShot]:
    """The sequences of one video: its shots between cuts, those that the user states, or all of it."""
    from stages.video.index import load_index
    from stages.video.shots import cut_out

    index = load_index(video, config.video, kept, cuts=stated == "auto")
    if not isinstance(stated, list):
        found = enumerate(index.shots.items(), start=1)
        flags = "" if stated == "auto" else " --no-cuts"
        return {name: VideoShot(video, index, shot, f"--shot {k}{flags}") for k, (name, shot) in found}
    (whole,) = index.shots.values()
    clip_shots.check_ranges(stated, 1, len(whole.pts), video.name)
    names = clip_shots.names_of(video.stem, len(stated))
    return {
        name: VideoShot(video, index, cut_out(whole, first, last), f"--no-cuts --first {first} --last {last}")
        for name, (first, last) in zip(names, stated, strict=True)
    }


def scene_files(config: Config) -> dict[str, Path]:
    """The scene files to render, by name: the whole library, one split of it, or chosen names and YAML files.

    Long scenes belong to neither the whole nor a split: they are chosen by name.

    Raises:
        InputError: for a file that does not exist or a name that is not in the library.
    """
    library = {path.stem: path for path in sorted(SCENES.glob("*.yaml"))}
    named_alone = {path.stem: path for path in sorted(SCENES.glob("long/*.yaml"))}
    if config.scenes == "all":
        return library
    if isinstance(config.scenes, str):
        return {name: path for name, path in library.items() if _scene(path).split == config.scenes}
    own = {Path(name).stem: Path(name) for name in config.scenes if name.endswith((".yaml", ".yml"))}
    for path in own.values():
        if not path.is_file():
            raise InputError(
                path, "a scene file", "nothing there", f"library scenes: {', '.join(library | named_alone)}"
            )
    named = [name for name in config.scenes if not name.endswith((".yaml", ".yml"))]
    return choose(named, library | named_alone, SCENES) | own


@functools.cache
def _scene(path: Path) -> "Scene":
    """The scene in a file; cached, since every job asks for its split, lens and size."""
    from stages.simulate.scene import load_scene

    return load_scene(path)


def used(config: Config, sequence: Sequence) -> Sequence:
    """The part of a sequence that is used."""
    limit = None if config.inspect.max_frames == "all" else config.inspect.max_frames
    times_s = sequence.times_s and sequence.times_s[:limit]
    return replace(sequence, frames=sequence.frames[:limit], numbers=sequence.numbers[:limit], times_s=times_s)


def zooms(config: Config, name: str) -> bool:
    """Whether the camera of a simulated sequence changes its focal length."""
    return len({key.zoom for key in _scene(scene_files(config)[name]).camera.keys}) > 1


def distorts(config: Config, name: str) -> bool:
    """Whether the lens of a simulated sequence distorts."""
    return _scene(scene_files(config)[name]).camera.distortion is not None


def decoded_folder(config: Config) -> Path:
    """Where frames of videos are written, a folder per sequence."""
    return Path("decoded", dataset_name(config))


def _decoded(name: str, folder: Path, of: VideoShot) -> Sequence:
    times_s, first = of.shot.times_s, of.shot.first
    numbers = list(range(first, first + len(times_s)))
    frames = [folder / f"frame_{n:04d}.png" for n in numbers]
    return Sequence(name, frames, numbers, of.index.width, of.index.height, times_s=times_s)


def _promised(name: str, scene: Path) -> Sequence:
    promise = _scene(scene)
    numbers = list(range(1, promise.frames + 1))
    return Sequence(name, [Path(f"frame_{n:04d}.png") for n in numbers], numbers, promise.width, promise.height)
