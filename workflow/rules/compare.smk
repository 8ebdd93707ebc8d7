# Inputs and flags of the rules that collect results of others: comparisons, evaluation, report.
TABLES = {
    "sweep": f"<results>/{DATASET}/sweep/costs.parquet",
    "scaling": f"<results>/{DATASET}/scaling/growth.parquet",
}
SCENE_PAGES = expand(
    "<results>/{dataset}/{seq}/gaussians/scene.html", dataset=DATASET, seq=SEQUENCES
)
os.environ.update(MOTIONSPLAT_REPORT=f"results/{DATASET}/report/index.html")


@functools.cache
def with_truth(sequence):
    """A sequence with the ground truth beside its frames; plans need it only for sequences that are compared."""
    return replace(SEQUENCES[sequence], truth=find_truth(Path(FOLDERS[sequence])))


def can_run(sequence, setting):
    """Whether the sequence has the ground truth that the setting takes as input.

    Simulated sequences have all of it, but the focal length may change, and the lens distort.
    """
    if CONFIG.dataset == configuration.SIMULATED:
        scene = Path(FOLDERS[sequence]).name
        if required_truth.takes_one_camera(setting) and datasets.zooms(CONFIG, scene):
            return False
        return not (
            required_truth.takes_straight_lens(setting)
            and datasets.distorts(CONFIG, scene)
        )
    return not required_truth.lacks_truth(setting, with_truth(sequence))


def needed_by(listed):
    """All files from which the rows of runs are computed, each once."""
    files = dict.fromkeys(
        path for run in listed for path in compared_runs.needed_files(run)
    )
    return [f"<results>/{DATASET}/{path}" for path in files]


@functools.cache
def listed_runs(comparison):
    """The runs of a comparison that is asked for, at least one; says, once, which sizes of the scaling are left out."""
    if not RUNS[comparison]:
        expected = "a setting under which a chosen sequence can run"
        advice = "name settings, and sequences with the truth that they take"
        refuse(OptionError([comparison], expected, "none", advice))
    if comparison == "scaling" and workflow.is_main_process:
        for name in SCALED_SEQUENCES:
            for line in sizes.distinct(CONFIGURED, SCALED, SEQUENCES[name])[1]:
                logger.warning(line)
    return RUNS[comparison]


def masked_baseline(name):
    """The input function of results of COLMAP with our masks; empty if the job's setting does not run it."""

    def of_job(wildcards):
        if not settings.runs_masked_baseline(setting_of(wildcards)):
            return []
        return [
            f"<results>/{wildcards.dataset}/{wildcards.seq}/{wildcards.setting}{name}"
        ]

    return of_job


def stage_stats(wildcards):
    """The time files of every stage before the evaluation; those of a repeated stage in the order of the rounds."""
    return [
        path
        for stage in MEASURED
        for path in artifacts(stage, f"stats/{stage}.json")(wildcards)
    ]


def open_page(pages):
    """Open the first page in the browser and name the others, each of which is a tab that needs memory of the GPU."""
    first, *others = (Path(page).absolute().as_uri() for page in pages)
    opened = webbrowser.open(first)
    print(
        *([] if opened else ["no browser found; open one of"]), first, *others, sep="\n"
    )


def asked_tables(wildcards):
    """The tables of comparisons that are among the targets: plain `snakemake` runs no comparison."""
    targets = workflow.dag_settings.targets
    return {name: path for name, path in TABLES.items() if name in targets}


def comparison_flags(wildcards, input):
    """The flags of the report for the tables of this run's or an earlier run's comparisons."""
    flag = {"sweep": "--sweep", "scaling": "--growth"}
    paths = {name: workflow.pathvars.apply(path) for name, path in TABLES.items()}
    return " ".join(
        f"{flag[name]} {shlex.quote(path)}"
        for name, path in paths.items()
        if hasattr(input, name) or Path(path).exists()
    )


def evaluated_folders(wildcards, input):
    """The results folder of every sequence, from its table of poses (params do not expand <results>)."""
    return [
        str(Path(table).parents[1])
        for table in input.tables
        if table.endswith("eval/poses.parquet")
    ]
