# Of a job: its setting, sequence and round, the artifacts that it reads, and the flags of its script.


def setting_of(wildcards):
    """The setting of a job; the configured one for rules without settings."""
    folder = getattr(wildcards, "setting", "")
    if folder not in SETTINGS:
        raise WorkflowError(
            f"no setting of this configuration is called '{folder[9:-1]}'"
        )
    return SETTINGS[folder]


def known_sequence(wildcards):
    """The name of a job's sequence, which is one of the chosen ones."""
    if wildcards.seq not in SEQUENCES:
        raise WorkflowError(
            f"no sequence of this configuration is called '{wildcards.seq}'"
        )
    return wildcards.seq


def of_job(function):
    """The function, its arguments noted where Snakemake would inspect it anew for every job."""
    overwrite_function_params(function, inspect.signature(function).parameters)
    return function


def flags(section):
    """The params function of a script's command-line flags: Snakemake reruns the script when they change."""
    return of_job(lambda wildcards: plan.flags_of(setting_of(wildcards), section))


def round_number(wildcards):
    """The round of a job, 1, 2, ...; paths of the last round and of stages that run once have no prefix."""
    digits = re.sub(r"\D", "", getattr(wildcards, "round", ""))
    return int(digits or setting_of(wildcards).config.rounds)


@functools.cache
def home_of(setting, stage, number):
    """The folder, within a sequence's, of a stage's results in a round under a setting; cached like the flags."""
    return plan.find_home(EVERY_SETTING, setting, stage, number)


def artifact_path(wildcards, stage, name, number):
    """The path of a file or folder that a stage makes in a round under the job's setting."""
    home = home_of(setting_of(wildcards), stage, number)
    return f"<results>/{wildcards.dataset}/{wildcards.seq}/{home}{name}"


def artifact(stage, name):
    """The input function of a file or folder that a stage makes, under the job's setting and in its round."""
    return of_job(
        lambda wildcards: artifact_path(wildcards, stage, name, round_number(wildcards))
    )


def for_formats(stage, name, *formats):
    """The input function of what a stage makes; empty if none of the export's formats that need it is asked for."""
    wanted = set(formats) & set(CONFIG.export.formats)
    return artifact(stage, name) if wanted else []


def artifacts(stage, name):
    """The input function of a stage's results in all of its rounds, in order (one, if rounds do not repeat it)."""

    @of_job
    def of_rounds(wildcards):
        numbers = plan.rounds_of(setting_of(wildcards), stage)
        return [artifact_path(wildcards, stage, name, number) for number in numbers]

    return of_rounds


def page_parts(stage):
    """Template, styles and scripts of a page that a stage writes: Snakemake sees Python code by its digest alone."""
    return sorted(map(str, (REPO / "stages" / stage / "templates").iterdir()))


def optional(stage, name, before=0, since=1):
    """The input function of a stage's results `before` rounds ago; empty if the stage does not run in that round.

    Nothing is read in rounds before `since`.
    """

    @of_job
    def of_round(wildcards):
        setting, now = setting_of(wildcards), round_number(wildcards)
        number = plan.round_to_read(setting, stage, now - before)
        if number is None or now < since:
            return []
        return artifact_path(wildcards, stage, name, number)

    return of_round


def for_estimated_masks(stage, name, before=0, since=1):
    """The input function of a stage's results, now or rounds ago; empty where masks are not estimated from them."""
    read = optional(stage, name, before, since) if before else artifact(stage, name)

    @of_job
    def of_setting(wildcards):
        estimates = setting_of(wildcards).config.segment.estimates
        return read(wildcards) if estimates else []

    return of_setting


def given_files(section):
    """The params function of what changes when a file is rewritten that the user hands in under a section."""

    @of_job
    def of_sequence(wildcards):
        config, sequence = setting_of(wildcards).config, SEQUENCES[wildcards.seq]
        return given_inputs.digest(config, section, sequence)

    return of_sequence


def optional_flags(*names):
    """The params function of the flags for those optional inputs, out of `names`, that a job has."""

    @of_job
    def of_paths(wildcards, input):
        paths = {f"--{name.replace('_', '-')}": input.get(name) for name in names}
        return " ".join(
            f"{flag} {shlex.quote(path)}" for flag, path in paths.items() if path
        )

    return of_paths


def of_flow(path):
    """The output path of flow, which is removed after its last reader unless it is to be kept."""
    return path if CONFIG.keep_flow else temp(path)


def scene_file(wildcards):
    """The scene file of a simulated sequence."""
    scenes = datasets.scene_files(CONFIG)
    if wildcards.seq not in scenes:
        raise WorkflowError(f"no scene is called '{wildcards.seq}'")
    return scenes[wildcards.seq]


def video_file(wildcards):
    """The video of a sequence."""
    if known_sequence(wildcards) not in VIDEO_SHOTS:
        raise WorkflowError(f"sequence '{wildcards.seq}' is not of a video")
    return str(VIDEO_SHOTS[wildcards.seq].video)


def frame_folder(wildcards):
    """The folder of frames of a sequence."""
    return FOLDERS[wildcards.seq]


def frame_source(wildcards):
    """The inputs of `inspect`: the folders of frames and of ground truth beside it, or what makes the frames writes.

    The simulator writes the manifest last. A folder stands for its files: its time changes when files are added or
    removed, and hundreds of files per sequence would slow down every plan.
    """
    name = known_sequence(wildcards)
    if CONFIG.dataset == configuration.SIMULATED:
        return {"manifest": f"simulated/{Path(FOLDERS[name]).name}.json"}
    if name in VIDEO_SHOTS:
        return {"frames": FOLDERS[name], "video": f"{FOLDERS[name]}.json"}
    folder = Path(FOLDERS[name])
    truth = truth_folders(folder).values()
    return {"frames": str(folder), "truth": [str(folder) for folder in truth]}


def part_flags(wildcards):
    """The flags of `inspect` for a shot of a folder of frames; none for a folder that is one sequence."""
    name = known_sequence(wildcards)
    if name not in PARTS:
        return ""
    part = PARTS[name]
    left_out = f" --left-out {shlex.quote(part.left_out)}" if part.left_out else ""
    return (
        f"--name {shlex.quote(name)} --first {part.first} --last {part.last}{left_out}"
    )


def burnt_in_mask(wildcards):
    """The user's mask of what is burnt into the frames: an input, so that a change of the file is noticed."""
    mask = setting_of(wildcards).config.inspect.burnt_in
    return str(mask) if isinstance(mask, Path) else []


def frame_times(wildcards):
    """What changes when a frame is rewritten; nothing for frames that a job of this run may still write."""
    if CONFIG.dataset == configuration.SIMULATED or VIDEO_SHOTS:
        return ""
    return frames_digest(SEQUENCES[known_sequence(wildcards)].frames)
