"""The parts of the report on accuracy against time: sentence, charts and tables of the sweep and of the scaling."""

from collections.abc import Mapping, Sequence

import numpy as np

from stages.comparisons import growth, tradeoff, tradeoff_charts
from stages.comparisons.tradeoff import Point
from stages.comparisons.tradeoff_charts import Measure
from stages.evaluate import summaries
from stages.report import embedding
from stages.report.figures import Figure
from stages.shared.tables import Column, Row, Table

CAMERA = Measure("Camera error (ATE, % of path)", "ATE (% of path)")
COLOUR = Measure("Held-out colour error (RMS, % of range)", "PSNR (dB)", decibel=True)
SECONDS = {CAMERA: "poses_wall_s", COLOUR: "wall_s"}
TITLES = {
    "presets": "Presets",
    "knobs": "Single knobs",
    "inputs": "Effect of each input",
    "masks": "Effect of masks on pose error",
    "baselines": "COLMAP, every variant",
    "claims": "Claims of the paper",
    "effects": "Effects: those decided on, all of them, none",
}
CHOICES = ("presets", "knobs")
"""Groups of settings that a user chooses from; the Pareto front is over these. The other groups show the effect of an
input or of a part of the method."""
BESIDE = ("presets", "inputs", "baselines")
"""Groups whose runs are also listed in the pose table."""
NO_EFFECT = 1e-3
"""The chart of a knob leaves out errors that it changes by less than this share."""
NOTE = (
    "Unweighted means over the swept sequences. Seconds are wall and CPU time of all stages up to the result; shared "
    "stages are counted in full, COLMAP and evaluation are left out. To poses: up to the last adjustment. "
    "Charts show wall seconds of our stages, which other load on the machine lengthens, and CPU seconds of COLMAP on "
    "its one thread. The tables of poses and of time give the numbers of threads. PSNR and SSIM are those of held-out "
    "frames. Scored: sequences with an ATE; failed: no or partial poses."
)
GROWING = {"wall_s": "wall time (s)", "peak_mb": "peak memory (MB)", "output_mb": "disk (MB)"}
"""What is drawn of a growth, and the labels of its axes."""
GROWTH_NOTE = (
    "value = fixed + factor x size ^ exponent, both parts at least 0, by least squares of the relative errors over the "
    "measured sizes. In brackets: the exponents that fit within 5 %. Constant: growth by less than 5 %. The fixed part "
    "contains the start of the process. Fewer than three sizes determine no exponent. COLMAP, the viewer and "
    "the scores are left out: no stage reads them."
)
SETTING = Column("setting", "setting")
ERRORS = (
    Column("ate_percent", "ATE", "% of path", 2),
    Column("rpe_rot_deg", "RPE", "degrees", 3),
    Column("focal_abs_percent", "focal error", "%, size", 1),
    Column("iou", "mask IoU", "0..1", 3),
    Column("boundary_f", "boundary F", "0..1", 3),
)
COLUMNS = (
    SETTING,
    Column("front", "on the front"),
    *ERRORS,
    Column("psnr_db", "PSNR", "dB", 2),
    Column("psnr_static_db", "PSNR static", "dB", 2),
    Column("psnr_dynamic_db", "PSNR dynamic", "dB", 2),
    Column("ssim", "SSIM", "0..1", 3),
    Column("poses_wall_s", "wall to poses", "s", 1),
    Column("poses_cpu_s", "CPU to poses", "s", 1),
    Column("wall_s", "wall", "s", 1),
    Column("cpu_s", "CPU", "s", 1),
    Column("peak_mb", "peak memory", "MB", 0),
    Column("model_mb", "model", "MB", 2),
    *(Column("n", "scored"), Column("sequences", "of"), Column("failed", "failed")),
)
TRAINING_NOTE = (
    "PSNR that both reach: the highest one on training frames, averaged over 50 steps, that both this run and the "
    "configured run reach. Seconds of training until then, without start-up. Means over the swept sequences. With a "
    "ratio above 1 the configured run is faster, by this factor. With a table of motions, not with a network, half of "
    "the steps render their frame by the motion of the frames around it, which leaves what moves a lower PSNR."
)
TRAINING_COLUMNS = (
    SETTING,
    Column("group", "group"),
    Column("step_ms", "per step", "ms", 1),
    Column("equal_psnr_db", "PSNR that both reach", "dB", 2),
    Column("equal_s", "this run reaches it in", "s", 1),
    Column("configured_equal_s", "configured run in", "s", 1),
    Column("equal_ratio", "ratio", "this / configured", 2),
    Column("sequences", "sequences"),
)


def sweep_part(costs: Sequence[Row], poses: Sequence[Row]) -> tuple[str, list[Figure], list[Table]]:
    """The sentence, the charts and a table per group of settings.

    Args:
        costs: rows of the sweep's table, one per sequence and setting.
        poses: rows of the pose table, for COLMAP on the same sequences.
    """
    rows = tradeoff.means(costs)
    swept = {row["sequence"] for row in costs}
    baseline = [row for row in poses if row["sequence"] in swept and str(row["method"]).startswith("COLMAP")]
    sentences, figures = [], []
    for measure in (CAMERA, COLOUR):
        points = _choices(rows, measure)
        presets = [p for row in rows if row["group"] == "presets" and (p := _point(row, measure))]
        rivals = _rivals(baseline) if measure is CAMERA else []
        if points:
            sentences.append(tradeoff.next_tenth(points, measure.name))
            figures.append(_overall(points, presets, rivals, measure))
    knobs = dict.fromkeys(row["knob"] for row in rows if row["knob"])
    figures += [figure for knob in knobs for figure in _knob(rows, knob)]
    return " ".join(sentences), figures, group_tables(rows)


def group_tables(rows: Sequence[Row]) -> list[Table]:
    """A table per group of settings, and the training to equal PSNR.

    Args:
        rows: means over the swept sequences, one per setting.
    """
    points = {measure: _choices(rows, measure) for measure in (CAMERA, COLOUR)}
    fronts = {m: {(p.seconds, p.error) for p in tradeoff.pareto_front(found)} for m, found in points.items() if found}
    groups = dict.fromkeys(row["group"] for row in rows)
    return [*(_table(group, rows, fronts) for group in groups), *_training_tables(rows)]


def _choices(rows: Sequence[Row], measure: Measure) -> list[Point]:
    """The settings that a user chooses from, as points."""
    return [p for row in rows if row["group"] in CHOICES and (p := _point(row, measure))]


def sequence_tables(costs: Sequence[Row]) -> list[Table]:
    """The effect of the masks on every sequence, if several were swept."""
    rows = [tradeoff.with_size(row) for row in costs if row["group"] == "masks"]
    if len({row["sequence"] for row in rows}) < 2:
        return []
    columns = (Column("sequence", "sequence"), SETTING, *ERRORS, Column("status", "status"))
    note = "No masks score 0 where something moves; true masks score 1 by definition."
    return [Table("sweep_masks_sequences", f"{TITLES['masks']}, every sequence", note, columns, rows)]


def pose_rows(costs: Sequence[Row], poses: Sequence[Row]) -> list[Row]:
    """Rows of the pose table for presets, inputs and COLMAP of the sweep, without those that are in `poses` already."""
    seconds = {"wall_s": "poses_wall_s", "cpu_s": "poses_cpu_s"}
    there = {(row["sequence"], row["method"]) for row in poses}
    rows = [
        row
        | {"method": row["setting"] if row["group"] == "baselines" else f"ours, {row['setting']}"}
        | {"protocol": f"run by the sweep ({row['group']})"}
        | {key: row[source] for key, source in seconds.items()}
        for row in costs
        if row["group"] in BESIDE and not row["is_default"]
    ]
    return [row for row in rows if (row["sequence"], row["method"]) not in there]


def _point(row: Row, measure: Measure) -> Point | None:
    """The means of a setting as a point; None if the error or the seconds are unknown."""
    value, seconds = row["psnr_db" if measure.decibel else "ate_percent"], row[SECONDS[measure]]
    if value is None or seconds is None:
        return None
    error = 100 * 10 ** (-value / 20) if measure.decibel else value
    complete = row["failed"] == 0
    label = str(row["setting"] if row["knob"] is None else row["value"])
    return Point(seconds, error, row["setting"], label, complete, bool(row["is_default"]))


def _rivals(rows: Sequence[Row]) -> list[Point]:
    means = [row for row in summaries.pose_means(list(rows)) if row["ate_percent"] is not None]
    return [
        Point(row["cpu_s"], row["ate_percent"], row["method"], row["method"], row["failed"] + row["partial"] == 0)
        for row in means
    ]


def _overall(points: list[Point], presets: list[Point], rivals: list[Point], measure: Measure) -> Figure:
    content = tradeoff_charts.draw_overall(points, presets, rivals, measure)
    what = measure.label.partition(" (")[0]
    words = [f"{p.name}: {float(measure.shown([p.error])[0]):.3g} in {p.seconds:.0f} s" for p in [*presets, *rivals]]
    alt = f"{measure.label} against seconds for {len(points)} settings. {'; '.join(words)}"
    return Figure(f"{what} against time", embedding.data_uri(content, "image/svg+xml"), alt)


def _knob(rows: Sequence[Row], knob: str) -> list[Figure]:
    """The chart of one knob, with a panel for each measure that it changes."""
    panels, words = [], []
    chosen = [row for row in rows if row["knob"] == knob]
    for measure in (CAMERA, COLOUR):
        values = [p for row in chosen if (p := _point(row, measure))]
        if values and np.ptp([p.error for p in values]) > NO_EFFECT * values[0].error:
            panels.append((measure, values))
            shown = measure.shown([p.error for p in values])
            listed = ", ".join(f"{p.label}: {y:.3g} in {p.seconds:.0f} s" for p, y in zip(values, shown, strict=True))
            words.append(f"{measure.label} of {listed}")
    if not panels:
        return []
    content = tradeoff_charts.draw_knob(panels)
    return [Figure(knob, embedding.data_uri(content, "image/svg+xml"), f"{knob}. {'; '.join(words)}")]


def _table(group: str, rows: Sequence[Row], on_front: Mapping[Measure, set[tuple[float, float]]]) -> Table:
    """The settings of a group, with the configured run for comparison."""
    chosen = [row for row in rows if row["group"] == group]
    if not any(row["is_default"] for row in chosen):
        configured = next((row for row in rows if row["is_default"]), None)
        chosen = [*([configured | {"setting": "as configured"}] if configured else []), *chosen]
    names = {CAMERA: "ATE", COLOUR: "PSNR"}

    def is_on_front(row: Row, measure: Measure) -> bool:
        point = _point(row, measure) if group in CHOICES else None
        return point is not None and (point.seconds, point.error) in on_front[measure]

    listed = [row | {"front": ", ".join(names[m] for m in on_front if is_on_front(row, m))} for row in chosen]
    return Table(f"sweep_{group}", TITLES.get(group, group), NOTE, COLUMNS, listed)


def _training_tables(rows: Sequence[Row]) -> list[Table]:
    """Seconds to equal PSNR of every run whose training differs from the configured one; no table if there is none."""
    trained = [row for row in rows if row["equal_s"] is not None and not row["is_default"]]
    listed = [row | {"equal_ratio": row["equal_s"] / row["configured_equal_s"]} for row in trained]
    return (
        [Table("sweep_training", "Training to equal PSNR", TRAINING_NOTE, TRAINING_COLUMNS, listed)] if listed else []
    )


def growth_part(rows: Sequence[Row]) -> tuple[list[Figure], list[Table]]:
    """Charts of time, memory and disk against the size along every axis, and a table of the fitted exponents.

    A table that older code collected has no disk.
    """
    figures = []
    for axis in dict.fromkeys(row["axis"] for row in rows):
        for measure, label in GROWING.items():
            series = growth.series_of(rows, axis, measure)
            if not series:
                continue
            content = tradeoff_charts.draw_growth(series, (axis, label))
            ends = [f"{stage} {values[0]:.3g} to {values[-1]:.3g}" for stage, (_, values) in series.items()]
            alt = f"{label} of every stage against {axis}: {', '.join(ends)}"
            title = f"{label.partition(' (')[0].capitalize()} against {axis}"
            figures.append(Figure(title, embedding.data_uri(content, "image/svg+xml"), alt))
    exponents = [Column(f"{m}_growth", words, "exponent (range)") for m, words in growth.MEASURES.items()]
    sizes = Column("from", "from"), Column("to", "to"), Column("sizes", "sizes")
    seconds = Column("fixed_s", "fixed part", "s", 1), Column("wall_s", "wall at the largest", "s", 1)
    columns = (Column("axis", "what grows"), Column("stage", "stage"), *sizes, *exponents, *seconds)
    off = Column("deviation_percent", "wall, off the fit", "% at most", 0)
    return figures, [Table("growth", "Growth of cost", GROWTH_NOTE, (*columns, off), growth.fit_rows(rows))]
