"""Whether the held-out frames leave enough to train on, checked while the rules are read."""

from collections.abc import Iterable

from stages.configuration.config import section
from stages.configuration.datasets import used
from stages.configuration.settings import Setting
from stages.shared.errors import OptionError
from stages.shared.sequences import Sequence
from stages.shared.split import SplitOptions, held_out


def check(runs: Iterable[tuple[Setting, Iterable[Sequence]]]) -> None:
    """Refuse a setting that leaves fewer than two frames of one of its sequences to train on.

    Raises:
        OptionError: for the first of them.
    """
    for setting, sequences in runs:
        split = section(setting.config, "scene")
        assert isinstance(split, SplitOptions), "the section of scene"
        for sequence in sequences:
            try:
                held_out(len(used(setting.config, sequence).frames), split)
            except OptionError as error:
                raise setting.error("scene.holdout_every", *error.words) from error
