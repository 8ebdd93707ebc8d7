# Shared by all stages: the checked configuration, the sequences and the settings.
import functools
import gc
import inspect
import math
import os
import re
import shlex
import sys
import webbrowser
from dataclasses import replace
from pathlib import Path

from snakemake.common import overwrite_function_params
from snakemake.common.configfile import load_configfile
from snakemake.exceptions import WorkflowError
from snakemake.utils import update_config

REPO = Path(workflow.basedir)
sys.path.insert(0, str(REPO))

from stages.configuration import (
    compared_runs,
    config as configuration,
    datasets,
    given_inputs,
    plan,
    required_truth,
    settings,
    sizes,
    sources,
    training_frames,
)
from stages.flow.edges import most_edges, most_loops
from stages.shared.artifacts import write_json
from stages.shared.chain import MEASURED
from stages.shared.devices import takes_gpu
from stages.shared.digest import code_digest
from stages.shared.disk import megabytes_written, told
from stages.shared.errors import InputError, OptionError
from stages.shared.images import reduced_size
from stages.shared.memory import WINDOW, Held, megabytes
from stages.shared.sequences import find_truth, frames_digest, truth_folders

# A plan of a thousand sequences consists of a million permanent objects. Searching all of them for garbage again and
# again delays the first job considerably.
gc.set_threshold(200_000, 50, 1000)

# Jobs run `python -m stages...` from any working directory with this environment's Python.
os.environ.update(
    PYTHONPATH=os.pathsep.join([str(REPO), os.environ.get("PYTHONPATH", "")]),
    PATH=os.pathsep.join(
        [str(Path(sys.executable).parent), os.environ.get("PATH", "")]
    ),
)


def own_sources():
    """The user's own files and flags with their values, without the shipped file, in the order in which they win."""
    files = [
        (sources.shown(path), load_configfile(path))
        for path in workflow.overwrite_configfiles
        if path.resolve() != (REPO / "config.yaml").resolve()
    ]
    return [*files, ("--config", dict(workflow.config_settings.config))]


def own_values(own):
    """The values from the user's own files and flags: they win over a preset."""
    values = {}
    for _, stated in own:
        update_config(values, stated)
    return values


OWN = own_sources()


def refuse(error):
    """End the run in one line about wrong input, which begins with the file or flag in which the value stands."""
    # The merged values stand for the shipped file, which names every option.
    shipped = sources.shown(REPO / "config.yaml"), config
    sys.stderr.write(f"{sources.named(error, [shipped, *OWN])}\n")
    sys.exit(2)


try:
    MINE = own_values(OWN)
    CONFIGURED = settings.configured(config, MINE)
    CONFIG = CONFIGURED.config
    datasets.require_folders(CONFIG)
    VIDEO_SHOTS = datasets.video_shots(CONFIG)
    CLIPS = datasets.frame_folders(CONFIG, VIDEO_SHOTS)
    # Jobs on a cluster read this file again; checking all headers once is enough.
    WHOLE = datasets.find_sequences(
        CONFIG, CLIPS, VIDEO_SHOTS, headers=workflow.is_main_process
    )
    SEQUENCES, PARTS = datasets.divided(CONFIG, WHOLE, VIDEO_SHOTS)
    FOLDERS = CLIPS | {name: CLIPS[part.clip] for name, part in PARTS.items()}
    SWEPT, SCALED = settings.compared(config, MINE)
    SWEPT_SEQUENCES = settings.choose_sequences(CONFIG.sweep, SEQUENCES)
    SCALED_SEQUENCES = settings.choose_sequences(CONFIG.scaling, SEQUENCES)
    if workflow.is_main_process:
        if "video" in MINE and not VIDEO_SHOTS:
            logger.warning(
                f"video: has no effect: {CONFIG.dataset} holds no video; inspect.max_frames takes the first frames"
            )
        planned = [
            (setting, [SEQUENCES[name] for name in names])
            for listed, names in (
                ([CONFIGURED], SEQUENCES),
                (SWEPT, SWEPT_SEQUENCES),
                (SCALED, SCALED_SEQUENCES),
            )
            for setting in listed
        ]
        training_frames.check(planned)
        given_inputs.check(
            planned, {name: of.video for name, of in VIDEO_SHOTS.items()}
        )
        if CONFIG.dataset != configuration.SIMULATED:
            required_truth.check(CONFIGURED, SEQUENCES, FOLDERS)
except InputError as error:
    refuse(error)

DATASET = datasets.dataset_name(CONFIG)
SETTINGS = {setting.folder: setting for setting in [CONFIGURED, *SWEPT, *SCALED]}
EVERY_SETTING = list(SETTINGS.values())


# profiles/default limits the number of jobs that use these on one machine; on a cluster each job has a machine.
resource_scopes:
    gpu="local",
    colmap="local",


# These are no lists of names: Snakemake would search them for every file, which takes long with many sequences.
wildcard_constraints:
    dataset=re.escape(DATASET),
    seq=r"[^/]+",
    setting=r"(settings/[^/]+/)?",
    round=r"(round\d+/)?",
