"""The tables of the report: columns, labels, units and protocols."""

from collections.abc import Sequence
from dataclasses import replace

from stages.evaluate import pose_diagnostics, summaries
from stages.shared.tables import Column, Row, Table

SEQUENCE, METHOD, N = Column("sequence", "sequence"), Column("method", "method"), Column("n", "sequences")
HOW = Column("protocol", "protocol", file_only=True)
ERRORS = (
    Column("ate", "ATE", "scene units", 4),
    Column("ate_percent", "ATE", "% of path", 2),
    Column("rpe_trans", "RPE", "scene units", 4),
    Column("rpe_rot_deg", "RPE", "degrees", 3),
)
SECONDS = Column("wall_s", "wall", "s", 1), Column("cpu_s", "CPU", "s", 1), Column("threads", "threads", "at most")
TAKEN = Column("taken", "not estimated")
IMAGE_SCORES = (
    Column("psnr_db", "PSNR", "dB", 2),
    Column("ssim", "SSIM", "0..1", 3),
    Column("lpips", "LPIPS", "0 is best", 3),
)
MASK_SCORES = (
    Column("iou", "IoU", "0..1", 3),
    Column("mover_iou", "IoU, movers at rest too", "0..1", 3),
    Column("boundary_f", "boundary F", "0..1", 3),
    Column("precision", "precision", "0..1", 3),
    Column("recall", "recall", "0..1", 3),
    Column("dynamic_percent", "called dynamic", "% of pixels", 1),
    Column("true_percent", "truly dynamic", "% of pixels", 1),
)
COSTS = (
    Column("threads", "threads", "at most"),
    Column("wall_s", "wall time", "s", 1, bar=True),
    Column("cpu_s", "CPU time", "s", 1, bar=True),
    Column("peak_mb", "peak memory", "MB", 0, bar=True),
    Column("gpu_peak_mb", "GPU memory", "MB", 0),
    Column("output_mb", "output", "MB", 2),
)


def pose_tables(rows: list[Row], protocol: str) -> tuple[Table, Table]:
    """Pose errors: means per method, and every sequence."""
    note = (
        f"{protocol}. Time: our stages from flow to adjustment; COLMAP's features, matching and mapping; threads: the "
        "largest number used."
    )
    focal = Column("focal_abs_percent", "focal error", "%, size", 1)
    counts = (
        Column("n", "scored"),
        Column("sequences", "of"),
        Column("partial", "partial"),
        Column("failed", "failed"),
    )
    mean = Table(
        "poses_mean",
        "Poses, mean over sequences",
        f"{note} Unweighted mean over the scored sequences; partial: some frames without a pose, not in the mean.",
        (METHOD, *ERRORS, focal, *SECONDS, *counts, TAKEN),
        summaries.pose_means(rows),
    )
    signed = (
        Column("focal_error_percent", "focal error", "%", 1),
        Column("focal_curve_mean_percent", "focal error, mean size over frames that zoom", "%", 2),
        Column("focal_curve_max_percent", "largest of a frame", "%", 2),
    )
    frames = Column("registered", "posed", "frames"), Column("total", "of", "frames")
    path = Column("path", "true path", "scene units", 2, file_only=True)
    about = Column("status", "status"), Column("note", "note", long=True), path
    decided = (replace(column, file_only=True) for column in pose_diagnostics.COLUMNS)  # shown in their own table
    columns = (SEQUENCE, METHOD, *ERRORS, *signed, *SECONDS, *frames, TAKEN, *about, HOW, *decided)
    return mean, Table("poses", "Poses of every sequence", f"{note} {statements(rows, 'method')}", columns, rows)


def image_tables(rows: list[Row], protocol: str) -> tuple[Table, Table]:
    """Image scores: means per split and region, and every sequence."""
    what = Column("split", "split"), Column("region", "pixels"), METHOD
    masks = "; ".join(dict.fromkeys(row["mask_source"] for row in rows if row["mask_source"]))
    regions = f"Static and dynamic pixels by: {masks or 'none'}."
    note = f"{protocol}. {statements(rows, 'split', 'method')} {regions}"
    means = summaries.image_means(rows)
    mean = Table("images_mean", "Images, mean over sequences", note, (*what, *IMAGE_SCORES, N), means)
    size = Column("width", "width", "px"), Column("height", "height", "px")
    sources = Column("mask_source", "regions", file_only=True), HOW
    columns = (SEQUENCE, *what, *IMAGE_SCORES, Column("frames", "n", "frames"), *size, *sources)
    return mean, Table("images", "Images of every sequence", note, columns, rows)


def mask_tables(rows: list[Row], protocol: str) -> tuple[Table, Table]:
    """Mask scores: means per method and round, and every sequence."""
    what = METHOD, Column("round", "round")
    note = f"{protocol}. Motion prior: its pixels above one half; the other rows are the masks that the run used."
    means = summaries.mask_means(rows)
    mean = Table("masks_mean", "Masks, mean over sequences", note, (*what, *MASK_SCORES, N), means)
    columns = (SEQUENCE, *what, *MASK_SCORES, Column("frames", "n", "frames"), Column("protocol", "what", long=True))
    return mean, Table("masks", "Masks of every sequence", note, columns, rows)


def time_tables(rows: list[Row]) -> tuple[Table, Table]:
    """Cost of every stage: means, and every sequence."""
    what = Column("stage", "stage"), Column("round", "round")
    note = "Whole process of each stage, imports included; peak memory is the resident set."
    mean_note = f"{note} Unweighted mean over sequences."
    mean = Table("time_mean", "Cost of every stage", mean_note, (*what, *COSTS, N), summaries.time_means(rows))
    return mean, Table("time", "Cost of every stage and sequence", note, (SEQUENCE, *what, *COSTS), rows)


def check_tables(rows: list[Row]) -> tuple[Table, Table]:
    """Checks of flow and depth, with and without ground truth, and of motion fit and file sizes: means, and all."""
    what, value, unit = Column("quantity", "quantity"), Column("value", "value"), Column("unit", "unit")
    note = statements(rows, "quantity")
    means = summaries.mean_rows(rows, ("quantity", "unit"), ("value",))
    mean = Table(
        "checks_mean", "Flow, depth, motion and size, mean over sequences", note, (what, value, unit, N), means
    )
    columns = (SEQUENCE, what, value, unit, Column("n", "n"), HOW)
    return mean, Table("checks", "Flow, depth, motion and size of every sequence", note, columns, rows)


def decision_table(rows: list[Row]) -> Table:
    """The effects that the reconstruction models, with the evidence."""
    what = Column("effect", "effect"), Column("modelled", "modelled"), Column("statistic", "saves", "", 2)
    range_ = Column("low", "from", "", 2), Column("high", "to", "", 2), Column("threshold", "threshold", "", 2)
    cost = Column("unit", "unit"), Column("seconds", "CPU time of the decision", "s", 1)
    how = Column("source", "decided by"), Column("settings", "settings", long=True)
    note = (
        "An effect is modelled if its model saves enough of the error on samples of the training frames that it was not"
        " fitted to: root mean square with two standard errors. A camera only turns if travel saves less than the"
        " threshold. 'user' marks a decision overruled by an option."
    )
    why = Column("why", "why", long=True), Column("evidence", "evidence", long=True)
    columns = (SEQUENCE, *what, *range_, *cost, why[0], *how, why[1])
    return Table("decisions", "Effects the reconstruction models", note, columns, rows)


def simulation_table(rows: list[Row]) -> Table:
    """The effects that the simulator rendered, with the time of each."""
    what = Column("effect", "effect"), Column("simulated", "simulated"), Column("seconds", "time", "s", 3)
    columns = (SEQUENCE, *what, Column("calls", "calls"), Column("settings", "settings", long=True))
    note = "An effect that the scene does not list is not run: it takes no time and changes no pixel."
    return Table("simulation", "Effects the simulator rendered", note, columns, rows)


def statements(rows: Sequence[Row], *names: str) -> str:
    """Every distinct protocol of the rows, once, preceded by the values of the columns `names` to which it applies."""
    found: dict[str, list[str]] = {}
    for row in rows:
        whose, listed = " ".join(str(row[name]) for name in names), found.setdefault(row["protocol"], [])
        if whose not in listed:
            listed.append(whose)
    return " ".join(f"{', '.join(whose)}: {protocol}." for protocol, whose in found.items())
