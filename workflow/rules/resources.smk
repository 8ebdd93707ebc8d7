# Resources of a job: memory, disk, GPUs, and the group in which it is submitted to a cluster.


def memory(stage):
    """The params function of a job's memory in megabytes, from the pixels of its stage; more at each attempt."""

    @of_job
    def of_attempt(wildcards, attempt):
        return megabytes(stage, held(setting_of(wildcards), wildcards.seq), attempt)

    return of_attempt


def disk(stage):
    """The resource function of what a job writes, in megabytes, from the pixels of its stage."""

    @of_job
    def of_sequence(wildcards):
        return megabytes_written(stage, held(setting_of(wildcards), wildcards.seq))

    return of_sequence


def tell_disk(jobs):
    """Log what jobs will write beside what is free, or end the run in one line if there is no room for it."""
    jobs = [job for job in jobs if job.resources.get("disk_mb")]
    needed = sum(job.resources.disk_mb for job in jobs)
    try:
        words = told(needed, [path for job in jobs for path in job.output])
    except InputError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(2)
    if jobs:
        logger.info(words)


@functools.cache
def held(setting, name):
    """The pixels of a sequence, or of a clip of several, and of its flow under a setting; cached like the flags."""
    sequence, config = SEQUENCES.get(name) or WHOLE[name], setting.config
    size, limit = (sequence.width, sequence.height), config.inspect.max_frames
    frames = len(sequence.frames)
    frames = frames if limit == "all" else min(frames, limit)
    per_frame = config.flow.offsets, config.flow.long_edges
    extra = given_inputs.added_edges(config, sequence)
    window = most_edges(min(frames, WINDOW), *per_frame) + extra
    extra += most_loops(frames) if config.flow.loops == "auto" else 0
    grid = math.prod(reduced_size(*size, config.flow.max_side_px))
    return Held(
        edges=(most_edges(frames, *per_frame) + extra) * grid,
        frames=frames * math.prod(size),
        frame=math.prod(size),
        grid=frames * grid,
        window=window * grid,
    )


def gpus(section):
    """The resource function of a job's GPUs: one if its stage runs on CUDA, else None, which omits the resource."""

    return of_job(lambda wildcards: gpus_of(setting_of(wildcards), section))


@functools.cache
def gpus_of(setting, section):
    """The GPUs of a stage's jobs under a setting; remembered, as every job asks."""
    options = configuration.section(setting.config, section)
    return 1 if takes_gpu(options.device) else None


def submission(name):
    """The function of a job's group: one submission to a cluster per sequence and setting. Local runs have no groups."""

    return of_job(
        lambda wildcards: submission_of(name, getattr(wildcards, "setting", ""))
    )


@functools.cache
def submission_of(name, folder):
    """The name of a group under the setting in a folder; remembered, as every job asks."""
    setting = folder.removeprefix("settings/")
    return re.sub(r"\W+", "_", f"{name}/{setting}").rstrip("_")


def video_memory(wildcards, attempt):
    """The memory of decoding a video, whose own frames may be larger than those that are written."""
    size = VIDEO_SHOTS[wildcards.seq].index.findings["coded_size"]
    return megabytes("video", Held(frame=math.prod(size)), attempt)


def colmap_memory(wildcards, attempt):
    """The memory of COLMAP, which may see enlarged frames."""
    setting = setting_of(wildcards)
    options = setting.config.colmap
    factor = max([*options.upsample, *options.upsample_masked]) ** 2
    seen = held(setting, wildcards.seq)
    return megabytes(
        "colmap",
        Held(frames=factor * seen.frames, frame=factor * seen.frame),
        attempt,
    )
