"""The steps of a setting and the folders of their results: settings share the steps in which they do not differ.

Snakemake derives the order of stages within one setting from their files. It cannot tell that two settings would give
equal results: that depends on options alone, and is decided here.
"""

import functools
from collections.abc import Sequence

from stages.configuration import config as configuration
from stages.configuration.settings import Setting, is_baseline
from stages.shared.chain import AFTER, BEFORE, REPEATED

Step = tuple[str, int]
"""A stage and the round in which it runs, 1, 2, ...; the last round for stages that rounds do not repeat."""


def repeated(setting: Setting) -> tuple[str, ...]:
    """The stages that rounds repeat: those of REPEATED, but masks that are not estimated are made once, before them."""
    return REPEATED if setting.config.segment.estimates else ("ba",)


def rounds_of(setting: Setting, stage: str) -> range:
    """The rounds in which a setting runs a stage: the last one for stages that rounds do not repeat.

    If `first_masks` is "none", the first of several rounds runs `ba` alone. Where masks are not estimated, `motion`
    runs in no round.
    """
    rounds, without = setting.config.rounds, setting.config.first_masks == "none"
    if stage == "motion" and stage not in repeated(setting):
        return range(0)
    if stage not in repeated(setting):
        return range(rounds, rounds + 1)
    return range(2 if stage != "ba" and without and rounds > 1 else 1, rounds + 1)


def round_to_read(setting: Setting, stage: str, number: int) -> int | None:
    """The round whose results of a stage a job of round `number` reads; None if there are none, as in round 0.

    What is made once, before the rounds, is that of every round.
    """
    rounds = rounds_of(setting, stage)
    if stage in REPEATED and stage not in repeated(setting):
        return rounds[0] if rounds and number > 0 else None
    return number if number in rounds else None


@functools.cache
def steps(setting: Setting, stage: str) -> tuple[Step, ...]:
    """All steps of a setting in order, up to `stage` in its last round; each step reads results of earlier ones.

    COLMAP is not part of this chain: it reads the frames alone.
    """
    last = setting.config.rounds
    if stage == "colmap":
        return (("inspect", last), ("colmap", last))
    again = repeated(setting)
    once = [(name, last) for name in REPEATED if name not in again and rounds_of(setting, name)]
    rounds = [(name, n) for n in range(1, last + 1) for name in again if n in rounds_of(setting, name)]
    chain = [*((name, last) for name in BEFORE), *once, *rounds, *((name, last) for name in AFTER)]
    return tuple(chain[: chain.index((stage, last)) + 1])


@functools.cache
def flags_of(setting: Setting, stage: str) -> str:
    """The command-line flags of a stage under a setting; cached, since every job and every comparison asks."""
    return configuration.flags(setting.config, stage)


@functools.cache
def _flags_up_to(setting: Setting, stage: str, number: int) -> tuple[tuple[str, str], ...]:
    """Every step up to the given one with its flags; if two settings agree in them, their results are equal."""
    chain = steps(setting, stage)
    chain = chain[: chain.index((stage, number)) + 1]
    if stage == "evaluate" and is_baseline(setting.overrides):  # the one stage that reads what COLMAP made
        chain = (*chain, ("colmap", number))
    return tuple((name, flags_of(setting, name)) for name, _ in chain)


def find_home(settings: Sequence[Setting], setting: Setting, stage: str, number: int) -> str:
    """The folder of a stage's results under a setting: that of the first setting with the same results.

    Args:
        settings: all settings, the configured one first.
        number: the round, one of `rounds_of`; ignored for stages that rounds do not repeat.

    Returns:
        "", or a prefix that ends with "/": "settings/<name>/", "round1/", "settings/<name>/round1/".

    Raises:
        ValueError: if `setting` is none of the settings, or does not run the stage in that round.
    """
    wanted = _flags_up_to(setting, stage, number if stage in repeated(setting) else setting.config.rounds)
    for other in settings:
        last = other.config.rounds
        same_round = number if stage in repeated(other) else last
        if same_round in rounds_of(other, stage) and _flags_up_to(other, stage, same_round) == wanted:
            return other.folder + ("" if same_round == last else f"round{same_round}/")
    raise ValueError(f"{setting.folder!r} is none of the settings")
