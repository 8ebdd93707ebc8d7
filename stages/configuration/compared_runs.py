"""The runs of a sweep and of a scaling: names and result paths for each sequence and setting.

Paths are relative to the folder of the dataset under results/.
"""

import functools
from collections.abc import Sequence
from typing import Any

from stages.configuration.comparison_options import GROWING
from stages.configuration.plan import find_home, rounds_of
from stages.configuration.settings import Setting
from stages.shared.chain import MEASURED

SIZES = {
    "frames": ("inspect", "sequence.json"),
    "pixels": ("flow", "stats/flow.json"),
    "gaussians": ("gaussians", "gaussians/model.safetensors"),
    "control points": ("control", "control/points.parquet"),
}
"""The stage and file from which the size along each axis of the scaling is read; the flow itself may be gone."""
CONVERGENCE = "gaussians/convergence.parquet"
SCORES = ("poses", "images", "masks", "time")


def swept_run(settings: Sequence[Setting], setting: Setting, sequence: str) -> dict[str, Any]:
    """Columns of the sweep's table that identify a run, and the paths of its scores, decisions, model and training.

    `shared` are the stages that all settings of its group share.
    """
    scores = _path(settings, setting, sequence, "evaluate", "eval")
    return {
        "sequence": sequence,
        "group": setting.group,
        "setting": setting.name,
        "knob": setting.knob,
        "value": setting.value,
        "overrides": setting.overrides,
        "is_default": scores == f"{sequence}/eval",
        "scores": scores,
        "scene": _path(settings, setting, sequence, "scene", "scene.json"),
        "model": _path(settings, setting, sequence, "gaussians", "gaussians/model.safetensors"),
        "convergence": _path(settings, setting, sequence, "gaussians", CONVERGENCE),
        "configured_convergence": f"{sequence}/{CONVERGENCE}",
        "stages": _stages(settings),
        "shared": _shared(tuple(settings), setting.group),
    }


def scaled_run(settings: Sequence[Setting], setting: Setting, sequence: str) -> dict[str, Any]:
    """Paths of the file with a run's size and of the time files of the stages on its axis, one file per round."""
    stats = {
        stage: [
            _path(settings, setting, sequence, stage, f"stats/{stage}.json", number)
            for number in rounds_of(setting, stage)
        ]
        for stage in GROWING[setting.group]
        if rounds_of(setting, stage)
    }
    return {
        "sequence": sequence,
        "stages": _stages(settings),
        "axis": setting.group,
        "size": _path(settings, setting, sequence, *SIZES[setting.group]),
        "stats": stats,
    }


def needed_files(run: dict[str, Any]) -> list[str]:
    """The files from which the row of a run (`swept_run` or `scaled_run`) is computed."""
    configured = [
        f"{run['sequence']}/sequence.json",
        *(f"{run['sequence']}/stats/{name}.json" for name in run["stages"]),
    ]
    if "scores" in run:
        trainings = dict.fromkeys((run["convergence"], run["configured_convergence"]))
        return [
            run["model"],
            run["scene"],
            *trainings,
            *(f"{run['scores']}/{table}.parquet" for table in SCORES),
            *configured,
        ]
    return [run["size"], *(path for paths in run["stats"].values() for path in paths), *configured]


def _stages(settings: Sequence[Setting]) -> dict[str, int]:
    """Number of rounds of each stage that the configured run has, which is the first of the settings."""
    rounds = {stage: len(rounds_of(settings[0], stage)) for stage in MEASURED}
    return {stage: number for stage, number in rounds.items() if number}


@functools.cache
def _shared(settings: tuple[Setting, ...], group: str) -> list[str]:
    """The stages that all settings of a group share; cached, since each of them asks for each sequence."""
    members = [setting for setting in settings if setting.group == group]
    return [stage for stage in MEASURED if len({_home(settings, member, stage) for member in members}) == 1]


def _home(settings: Sequence[Setting], setting: Setting, stage: str) -> str | None:
    """The folder of the last results of a stage; None if the setting does not run it."""
    rounds = rounds_of(setting, stage)
    return find_home(settings, setting, stage, rounds[-1]) if rounds else None


def _path(
    settings: Sequence[Setting], setting: Setting, sequence: str, stage: str, name: str, number: int | None = None
) -> str:
    home = find_home(settings, setting, stage, setting.config.rounds if number is None else number)
    return f"{sequence}/{home}{name}"
