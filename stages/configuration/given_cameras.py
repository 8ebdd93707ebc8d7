"""Files of cameras that the options name: checked while the rules are read, and inputs of the stage that reads them."""

from collections.abc import Iterable
from pathlib import Path

from stages.ba.options import BAOptions
from stages.configuration.config import Config, section
from stages.given.cameras_files import PLACE, files_of, path_of, require
from stages.given.intrinsics import ESTIMATE, TRUTH, parse
from stages.shared.errors import InputError


def check_camera_files(config: Config, names: Iterable[str]) -> None:
    """Check that the files of cameras that a configuration names exist, one for each of the sequences `names`.

    Raises:
        InputError: for a file that does not exist, and one file for several sequences.
    """
    sequences = list(names)
    for option, path in _paths(config).items():
        if PLACE not in path and len(sequences) > 1:
            expected = f"a path with {PLACE}, which stands for the name of each of the {len(sequences)} sequences"
            advice = f"as in cameras/{PLACE}.txt, or choose one by `sequences:`"
            raise InputError(f"config.yaml: {option}", expected, f"'{path}'", advice)
        for name in sequences:
            require(path_of(path, name))


def camera_files(config: Config, name: str) -> list[Path]:
    """The files of cameras that `ba` reads for the sequence of this name."""
    return [file for path in _paths(config).values() for file in files_of(path_of(path, name))]


def _paths(config: Config) -> dict[str, str]:
    """The paths of files of cameras, by the option that holds them."""
    options = section(config, "ba")
    assert isinstance(options, BAOptions), "the section of ba"
    found = {"intrinsics": parse(options.intrinsics).path}
    found |= {"ba.poses_from": "" if options.poses_from in (ESTIMATE, TRUTH) else options.poses_from}
    return {option: path for option, path in found.items() if path}
