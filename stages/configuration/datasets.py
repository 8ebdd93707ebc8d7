"""The sequences of the chosen dataset: folders of frames, or scenes that the simulator will render."""

import functools
from collections.abc import Mapping
from pathlib import Path

from stages.configuration.config import SIMULATED, Config
from stages.shared.errors import InputError
from stages.shared.sequences import Sequence, check_headers, choose, list_sequence, sequence_folders

SCENES = Path(__file__).parents[1] / "simulate" / "scenes"
"""The scene library."""
EARLY_FRAMES = 1000
"""So many frames are checked one by one before any work; of more, the first of each sequence. `inspect` checks all.

Thousands of headers take seconds, on the file systems of clusters minutes.
"""


def dataset_name(config: Config) -> str:
    """The folder name under results/."""
    return SIMULATED if config.dataset == SIMULATED else Path(config.dataset).resolve().name


def find_sequences(config: Config, folders: Mapping[str, str], headers: bool = True) -> dict[str, Sequence]:
    """The chosen sequences with frames and sizes, but without truth; simulated ones as their scene files promise.

    Args:
        folders: the folder of frames of every chosen sequence.
        headers: read those of all frames, where there are no more than EARLY_FRAMES; else that of each first frame.

    Raises:
        InputError: for too few frames, gaps in their numbers and unreadable frames.
    """
    if config.dataset == SIMULATED:
        scenes = scene_files(config)
        return {name: _promised(name, scenes[name]) for name in folders}
    sequences = {name: list_sequence(name, Path(folder)) for name, folder in folders.items()}
    if headers and sum(len(sequence.frames) for sequence in sequences.values()) <= EARLY_FRAMES:
        for sequence in sequences.values():
            check_headers(sequence)
    return sequences


def frame_folders(config: Config) -> dict[str, str]:
    """The folder of frames of every chosen sequence; simulated ones lie under simulated/."""
    dataset = Path(config.dataset)
    if config.dataset == SIMULATED:
        folders = {name: Path(SIMULATED, "training", config.pass_, name) for name in scene_files(config)}
    else:
        folders = sequence_folders(dataset, config.pass_)
    return {name: str(folder) for name, folder in choose(config.sequences, folders, dataset).items()}


def scene_files(config: Config) -> dict[str, Path]:
    """The scenes to render, by name: the whole library or one split of it, names from it, or paths of YAML files."""
    library = {path.stem: path for path in sorted(SCENES.glob("*.yaml"))}
    if config.scenes == "all":
        return library
    if isinstance(config.scenes, str):
        return {name: path for name, path in library.items() if _split(path) == config.scenes}
    own = {Path(name).stem: Path(name) for name in config.scenes if name.endswith((".yaml", ".yml"))}
    for path in own.values():
        if not path.is_file():
            raise InputError(path, "a scene file", "nothing there", f"library scenes: {', '.join(library)}")
    named = [name for name in config.scenes if not name.endswith((".yaml", ".yml"))]
    return choose(named, library, SCENES) | own


@functools.cache
def _split(scene: Path) -> str | None:
    """Which part of the library a scene belongs to; remembered, as every job asks."""
    from stages.simulate.scene import load_scene

    return load_scene(scene).split


def zooms(config: Config, name: str) -> bool:
    """Whether the camera of a simulated sequence changes its focal length."""
    from stages.simulate.scene import load_scene

    return len({key.zoom for key in load_scene(scene_files(config)[name]).camera.keys}) > 1


def _promised(name: str, scene: Path) -> Sequence:
    from stages.simulate.scene import load_scene

    promise = load_scene(scene)
    numbers = list(range(1, promise.frames + 1))
    return Sequence(name, [Path(f"frame_{n:04d}.png") for n in numbers], numbers, promise.width, promise.height)
