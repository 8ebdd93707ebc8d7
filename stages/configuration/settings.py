"""Settings: option overrides under which the same sequences run again; stages that do not differ are shared."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from stages.configuration import config as configuration
from stages.configuration.comparison_options import Knobs, ScalingOptions, SweepOptions
from stages.configuration.config import SHARED_KEYS, Config
from stages.configuration.presets import Overrides, override, value_of
from stages.shared.chain import MEASURED
from stages.shared.errors import OptionError
from stages.shared.options import validate

BUILT_IN = ("presets", "knobs")
"""Groups of the sweep that are not under `runs`."""


@dataclass(frozen=True, eq=False)
class Setting:
    """One way to run a sequence.

    Attributes:
        folder: of its results, within that of the sequence: "" for the configured run, or "settings/<name>/".
        group: the comparison that it belongs to, as under `sweep:` or `scaling:`. name: unique within the group.
        knob, value: the dotted name and the value of the varied option, if the setting is one of a series.
        overrides: the options in which it differs from the configured run, by dotted name.
        place: the keys that lead to it in the configuration.
    """

    folder: str
    config: Config
    group: str = ""
    name: str = ""
    knob: str | None = None
    value: Any = None
    overrides: Overrides = field(default_factory=dict)
    place: tuple[str, ...] = ()

    def error(self, option: str, expected: str, found: str, advice: str) -> OptionError:
        """What is wrong with the value of a stage's option under this setting, by its dotted name."""
        keys = configuration.keys_of(self.config, option)
        wrong = OptionError(keys, expected, found, advice)
        return wrong.of_setting(self.place, _title(self)) if wrong.name in self.overrides else wrong


def configured(raw: Mapping[str, Any], mine: Mapping[str, Any] | None = None) -> Setting:
    """The run that config.yaml describes; `mine` holds the values from the user's own files and flags.

    Raises:
        InputError: one line for the first option that is wrong.
    """
    return Setting("", configuration.load(raw, mine))


def compared(raw: Mapping[str, Any], mine: Mapping[str, Any] | None = None) -> tuple[list[Setting], list[Setting]]:
    """The settings of the sweep and of the scaling.

    Raises:
        InputError: one line for the first setting that is wrong.
    """
    config = configuration.load(raw, mine)
    groups = _groups(config.sweep)
    listed = [*_presets(config), *_series("knobs", config.sweep.knobs, config, ("sweep", "knobs")), *_runs(config)]
    sweep = [run for run in listed if run.group in groups]
    axes = config.scaling.axes.items()
    scaling = [run for axis, knobs in axes for run in _series(axis, knobs, config, ("scaling", "axes", axis))]
    settings = [[_setting(raw, mine, run) for run in runs] for runs in (sweep, scaling)]
    _refuse_equal_folders(settings[0] + settings[1])
    return settings[0], settings[1]


class _Run(NamedTuple):
    """A setting that is asked for: attributes as in `Setting`."""

    group: str
    name: str
    overrides: Overrides
    place: tuple[str, ...]
    knob: str | None = None
    value: Any = None


def _groups(options: SweepOptions) -> list[str]:
    """The groups of settings that the sweep runs.

    Raises:
        InputError: for a group that does not exist, or a name under `runs` that is taken.
    """
    for name in options.runs:
        if name in BUILT_IN:
            expected = f"another name than {' and '.join(BUILT_IN)}, which are groups of their own"
            raise OptionError(["sweep", "runs", name], expected, f"'{name}'", "rename the group")
    known = [*BUILT_IN, *options.runs]
    if options.groups == "all":
        return known
    for name in options.groups:
        if name not in known:
            expected = f"some of {', '.join(known)}"
            raise OptionError(["sweep", "groups"], expected, f"'{name}'", "name one of these")
    return options.groups


def _presets(config: Config) -> Iterator[_Run]:
    yield from (_Run("presets", name, {"preset": name}, ("sweep", "presets")) for name in config.sweep.presets)


def _series(group: str, knobs: Knobs, config: Config, place: tuple[str, ...]) -> Iterator[_Run]:
    """One run per value of each knob, the configured value among them."""
    values = config.model_dump(mode="json", by_alias=True)
    for knob, wanted in knobs.items():
        present = value_of(values, knob)
        for value in [*wanted, *([present] if wanted and present not in wanted else [])]:
            text = ",".join(map(str, value)) if isinstance(value, list) else str(value)
            yield _Run(group, f"{knob}={text}", {knob: value}, (*place, knob), knob, value)


def _runs(config: Config) -> Iterator[_Run]:
    """The runs of every group, with the options that may be varied."""
    kept = configuration.idle_effects(config)
    for group, runs in config.sweep.runs.items():
        for name, changes in (runs or {}).items():
            if changes is not None:
                chosen = {option: value for option, value in changes.items() if option not in kept}
                yield _Run(group, name, chosen, ("sweep", "runs", group, name))


def _setting(raw: Mapping[str, Any], mine: Mapping[str, Any] | None, run: _Run) -> Setting:
    try:
        for option in run.overrides:
            _refuse_data(option, is_knob=run.knob is not None)
        overrides = run.overrides | _idle(override(raw, run.overrides), run.overrides)
        chosen = override(mine or {}, {name: value for name, value in overrides.items() if name != "preset"})
        config = configuration.load(override(raw, overrides), chosen)
    except OptionError as error:
        raise error.of_setting(run.place, _title(run)) from error
    words = run.name if run.knob else f"{run.group}-{run.name}"
    folder = f"settings/{re.sub(r'[^A-Za-z0-9_.,=+-]+', '_', words)}/"
    return Setting(folder, config, run.group, run.name, run.knob, run.value, overrides, run.place)


def _idle(raw: Mapping[str, Any], overrides: Overrides) -> Overrides:
    """The effects that the configuration asks for and a run does without, since its inputs leave no room for them."""
    asked = [option for option in configuration.idle_effects(validate(Config, raw)) if option not in overrides]
    return {option: "auto" for option in asked if value_of(raw, option) in ("yes", True)}


def _title(run: "_Run | Setting") -> str:
    return f"setting '{run.name}' of '{run.group}'"


def _refuse_data(option: str, is_knob: bool) -> None:
    """Refuse options that choose the sequences, and options of COLMAP as knobs: a knob varies our own stages."""
    section, _, _ = option.partition(".")
    stages = [stage for stage in (*MEASURED, "evaluate") if not (is_knob and stage == "colmap")]
    if section not in (*stages, *SHARED_KEYS, "rounds", "first_masks", "preset"):
        expected = f"an option of {', '.join(stages)}, or one of {', '.join(SHARED_KEYS)}, rounds, first_masks"
        raise OptionError(option.split("."), expected, f"'{option}'", "write it as section.option")


def choose_sequences(options: SweepOptions | ScalingOptions, names: Iterable[str]) -> list[str]:
    """The sequences of a comparison, out of the chosen ones (`names`).

    Raises:
        InputError: for a sequence that is not among `names`.
    """
    known = list(names)
    if isinstance(options.sequences, str):
        return known[:1] if options.sequences == "first" else known
    for name in options.sequences:
        if name not in known:
            advice = "name sequences that `sequences:` chooses"
            comparison = "sweep" if isinstance(options, SweepOptions) else "scaling"
            raise OptionError([comparison, "sequences"], f"one of {', '.join(known)}", f"'{name}'", advice)
    return options.sequences


def is_baseline(overrides: Iterable[str]) -> bool:
    """Whether a setting varies COLMAP instead of our own stages."""
    return any(option.startswith("colmap.") for option in overrides)


def runs_masked_baseline(setting: Setting) -> bool:
    """Whether a setting runs COLMAP with our masks; those that vary our own stages do not."""
    chosen = not setting.folder or is_baseline(setting.overrides)
    return bool(chosen and setting.config.colmap.upsample_masked)


def _refuse_equal_folders(settings: Sequence[Setting]) -> None:
    found: dict[str, Setting] = {}
    for setting in settings:
        other = found.setdefault(setting.folder, setting)
        if other.overrides != setting.overrides:
            names = f"'{other.name}', '{setting.name}'"
            raise OptionError(setting.place, "names that differ", names, "rename one")
