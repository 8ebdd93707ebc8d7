"""Settings that take ground truth as input, and which sequences have it."""

import functools
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from stages.configuration.config import Config, keys_of, section
from stages.configuration.datasets import used
from stages.configuration.settings import Setting
from stages.shared import sintel
from stages.shared.errors import InputError
from stages.shared.sequences import Sequence, find_truth

TRUTH = {
    "flow.source": ("flow", "depth", "camdata_left"),
    "segment.source": ("motion_mask",),
    "ba.intrinsics": ("camdata_left",),
    "ba.poses_from": ("camdata_left",),
    "ba.depth_from": ("depth",),
}
"""The kinds of ground truth that each option needs when it is set to "truth"."""
ONE_CAMERA = ("ba.intrinsics", "ba.poses_from")
"""Options that, set to "truth", need a true camera with one focal length throughout."""
STRAIGHT = ("flow.source",)
"""Options that, set to "truth", need frames of a pinhole: the flow is found before the lens is."""


def check(setting: Setting, sequences: Mapping[str, Sequence], folders: Mapping[str, str]) -> None:
    """Look for the ground truth that the configured run takes as input, beside the frames in `folders`.

    Raises:
        InputError: for the first option that takes what a sequence lacks, and for true cameras that differ.
    """
    taken = _taken(setting)
    for name in sequences if taken else ():
        truth = find_truth(Path(folders[name]))
        sequence = used(setting.config, replace(sequences[name], truth=truth))
        for option in taken:
            if missing := _missing(option, sequence):
                kinds, default = ", ".join(TRUTH[option]), _default(setting.config, option)
                advice = f"set '{'.'.join(keys_of(setting.config, option))}' to '{default}'"
                expected = f"{kinds} of every frame of '{name}' for 'truth'"
                raise setting.error(option, expected, f"{', '.join(missing)} missing or incomplete", advice)
        if takes_one_camera(setting):
            sintel.read_shared_intrinsics(sequence.truth_files("camdata_left"))


def lacks_truth(setting: Setting, sequence: Sequence) -> bool:
    """Whether a sequence lacks ground truth that a setting takes as input.

    True cameras whose focal length changes count as lacking where the adjustment would take them.
    """
    sequence = used(setting.config, sequence)
    if any(_missing(option, sequence) for option in _taken(setting)):
        return True
    return takes_one_camera(setting) and not _has_one_camera(sequence)


def takes_one_camera(setting: Setting) -> bool:
    """Whether a setting gives true cameras to the adjustment, which has one focal length for all frames."""
    return any(option in ONE_CAMERA for option in _taken(setting))


def takes_straight_lens(setting: Setting) -> bool:
    """Whether a setting takes truth that there is of a pinhole alone."""
    return any(option in STRAIGHT for option in _taken(setting))


@functools.cache
def _taken(setting: Setting) -> list[str]:
    """The options that take ground truth; cached, since every sequence asks."""
    named = {option: option.split(".") for option in TRUTH}
    return [option for option, (name, key) in named.items() if getattr(section(setting.config, name), key) == "truth"]


def _missing(option: str, sequence: Sequence) -> list[str]:
    """What an option needs and a sequence lacks: kinds of ground truth, or a lens that does not distort."""
    lacking = [kind for kind in TRUTH[option] if not sequence.has_truth(kind)]
    if option in STRAIGHT and sequence.truth.get("distortion"):
        lacking.append("a lens without distortion")
    return lacking


def _default(config: Config, option: str) -> str:
    name, key = option.split(".")
    return str(type(getattr(config, name)).model_fields[key].default)


def _has_one_camera(sequence: Sequence) -> bool:
    try:
        sintel.read_shared_intrinsics(sequence.truth_files("camdata_left"))
    except InputError:
        return False
    return True
