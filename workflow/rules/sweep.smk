# The same sequences under other settings: what accuracy costs (sweep), and how cost grows (scaling).


def compared_path(sequence, setting, stage, name, number=None):
    """A file of a stage under a setting, relative to the folder of the dataset."""
    number = number or setting.config.rounds
    home = settings.find_home(list(SETTINGS.values()), setting, stage, number)
    return f"{sequence}/{home}{name}"


def swept_run(sequence, setting):
    """What the sweep's table says about a run, and where its scores and its model lie."""
    scores = compared_path(sequence, setting, "evaluate", "eval")
    return {
        "sequence": sequence,
        "group": setting.group,
        "setting": setting.name,
        "knob": setting.knob,
        "value": setting.value,
        "overrides": setting.overrides,
        "is_default": scores == f"{sequence}/eval",
        "scores": scores,
        "model": compared_path(
            sequence, setting, "gaussians", "gaussians/model.safetensors"
        ),
    }


def scaled_run(sequence, setting):
    """Where the sizes and the costs of a run lie, for the stages that its axis measures."""
    rounds = range(1, setting.config.rounds + 1)
    stats = {
        stage: [
            compared_path(sequence, setting, stage, f"stats/{stage}.json", number)
            for number in (rounds if stage in settings.REPEATED else [None])
        ]
        for stage in GROWING[setting.group]
    }
    stage, name = SIZES[setting.group]
    size = compared_path(sequence, setting, stage, name)
    return {"axis": setting.group, "size": size, "stats": stats}


def can_run(sequence, setting):
    """Whether the sequence has the truth that the setting takes as input; simulated ones have all."""
    if DATASET == configuration.SIMULATED:
        return True
    return not settings.lacks_truth(setting, SEQUENCES[sequence])


SIZES = {
    "frames": ("inspect", "sequence.json"),
    "pixels": ("flow", "flow/pairs.arrow"),
    "gaussians": ("gaussians", "gaussians/model.safetensors"),
    "control points": ("control", "control/points.parquet"),
}
RUNS = {
    "sweep": [
        swept_run(name, s)
        for name in SWEPT_SEQUENCES
        for s in SWEPT
        if can_run(name, s)
    ],
    "scaling": [scaled_run(name, s) for name in SCALED_SEQUENCES for s in SCALED],
}
TABLES = {
    "sweep": f"<results>/{DATASET}/sweep/costs.parquet",
    "scaling": f"<results>/{DATASET}/scaling/growth.parquet",
}


def under_dataset(paths):
    """Paths relative to the folder of the dataset as Snakemake's, each once."""
    return [f"<results>/{DATASET}/{path}" for path in dict.fromkeys(paths)]


rule list_runs:
    output:
        runs=f"<results>/{DATASET}/{{comparison}}/runs.json",
    wildcard_constraints:
        comparison="sweep|scaling",
    localrule: True
    params:
        runs=lambda wildcards: RUNS[wildcards.comparison],
    run:
        write_json(Path(output.runs), {"runs": params.runs})


rule collect_sweep:
    input:
        runs=f"<results>/{DATASET}/sweep/runs.json",
        scores=under_dataset(
            f"{run['scores']}/{table}.parquet"
            for run in RUNS["sweep"]
            for table in ("poses", "images", "masks", "time")
        ),
        models=under_dataset(run["model"] for run in RUNS["sweep"]),
    output:
        table=TABLES["sweep"],
    log:
        f"<logs>/{DATASET}/sweep.log",
    conda:
        "../envs/motionsplat.yaml"
    params:
        code=code_digest("stages.eval.sweep"),
    shell:
        "python -m stages.eval.sweep --runs {input.runs} --output {output.table} --log {log}"


rule collect_scaling:
    input:
        runs=f"<results>/{DATASET}/scaling/runs.json",
        sizes=under_dataset(run["size"] for run in RUNS["scaling"]),
        stats=under_dataset(
            path
            for run in RUNS["scaling"]
            for paths in run["stats"].values()
            for path in paths
        ),
    output:
        table=TABLES["scaling"],
    log:
        f"<logs>/{DATASET}/scaling.log",
    conda:
        "../envs/motionsplat.yaml"
    params:
        code=code_digest("stages.eval.scaling"),
    shell:
        "python -m stages.eval.scaling --runs {input.runs} --output {output.table} --log {log}"


def asked_tables(wildcards):
    """The tables of comparisons that are among the targets: plain `snakemake` runs no comparison."""
    targets = workflow.dag_settings.targets
    return {name: path for name, path in TABLES.items() if name in targets}


def comparison_flags(wildcards, input):
    """The flags of the report for tables that were just made or lie there from an earlier comparison."""
    paths = {name: workflow.pathvars.apply(path) for name, path in TABLES.items()}
    there = [
        name for name in paths if hasattr(input, name) or Path(paths[name]).exists()
    ]
    words = {"sweep": "--sweep", "scaling": "--growth"}
    return " ".join(f"{words[name]} {paths[name]}" for name in there)
