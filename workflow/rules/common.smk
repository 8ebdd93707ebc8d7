# Shared by all stages: the checked configuration, the sequences, code digests, flags and memory.
import os
import re
import sys
from pathlib import Path

REPO = Path(workflow.basedir)
sys.path.insert(0, str(REPO))

from stages import config as settings
from stages.shared.digest import code_digest
from stages.shared.errors import InputError

# Jobs run `python -m stages...` from any working directory with this environment's Python.
os.environ.update(
    PYTHONPATH=os.pathsep.join([str(REPO), os.environ.get("PYTHONPATH", "")]),
    PATH=os.pathsep.join(
        [str(Path(sys.executable).parent), os.environ.get("PATH", "")]
    ),
)


try:
    CONFIG = settings.load(config)
    SEQUENCES = settings.find_sequences(CONFIG)
    FOLDERS = settings.frame_folders(CONFIG)
except InputError as error:
    sys.stderr.write(f"{error}\n")
    sys.exit(2)

DATASET = settings.dataset_name(CONFIG)


wildcard_constraints:
    dataset=re.escape(DATASET),
    seq="|".join(map(re.escape, SEQUENCES)),
    round=r"(round\d+/)?",


def flags(section):
    """The command-line flags of one script: Snakemake reruns it when they change."""
    return settings.flags(CONFIG, section)


def megabytes(base, bytes_per_pixel):
    """Memory of a job: a base and a share per pixel of the sequence (frames x width x height)."""

    def of_job(wildcards):
        sequence = SEQUENCES[wildcards.seq]
        pixels = len(sequence.frames) * sequence.width * sequence.height
        return base + round(bytes_per_pixel * pixels / 1e6)

    return of_job


def previous_cameras(wildcards):
    """Poses and depth of the round before, for the next one; nothing in the first. The last round has no prefix."""
    number = int(re.sub(r"\D", "", wildcards.round) or CONFIG.rounds)
    if number == 1:
        return {}
    folder = f"<results>/{wildcards.dataset}/{wildcards.seq}/round{number - 1}/ba"
    return {
        "previous_poses": f"{folder}/poses.parquet",
        "previous_depth": f"{folder}/depth.arrow",
    }


def previous_flags(wildcards, input):
    """The flags that hand over the round before."""
    if not hasattr(input, "previous_poses"):
        return ""
    return f"--previous-poses {input.previous_poses} --previous-depth {input.previous_depth}"


def scene_file(wildcards):
    """The scene file of a simulated sequence."""
    return settings.scene_files(CONFIG)[wildcards.seq]


def frame_folder(wildcards):
    """The folder of frames of a sequence."""
    return FOLDERS[wildcards.seq]


def frame_source(wildcards):
    """What `inspect` depends on: the frames, or the manifest that the simulator writes last."""
    if DATASET == settings.SIMULATED:
        return {"manifest": f"simulated/{wildcards.seq}.json"}
    return {"frames": [str(path) for path in SEQUENCES[wildcards.seq].frames]}


def stage_stats(wildcards):
    """The time files of every stage up to the evaluation, of all rounds."""
    folder = f"<results>/{wildcards.dataset}/{wildcards.seq}"
    once = [
        f"{folder}/stats/{name}.json"
        for name in (
            "inspect",
            "flow",
            "scene",
            "control",
            "gaussians",
            "render",
            "colmap",
        )
    ]
    rounds = ["", *(f"round{number}/" for number in range(1, CONFIG.rounds))]
    return once + [
        f"{folder}/{part}stats/{name}.json"
        for part in rounds
        for name in ("motion", "segment", "ba")
    ]


def evaluated_folders(wildcards, input):
    """The results folder of every sequence, from its table of poses (params do not expand <results>)."""
    return [
        str(Path(table).parents[1])
        for table in input.tables
        if table.endswith("eval/poses.parquet")
    ]
