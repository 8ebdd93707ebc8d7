"""The part of the report on effects: those decided on against all of them and none, per scene and averaged."""

from collections.abc import Sequence

from stages.comparisons import priced, priced_chart
from stages.comparisons.priced import Scene
from stages.report import embedding
from stages.report.figures import Figure
from stages.shared.tables import Column, Row, Table

NOTE = (
    "Decided: as scene.json, the adjustment and the lens stage decide by evidence. All: every effect on, but for "
    "distortion that cannot be measured, fog whose fitted extinction is 0, the zoom of a camera that does not move or "
    "has known intrinsics, and the rolling shutter of one that hardly moves. None: a static scene in steady light "
    "before a pinhole; neither masks nor control points are made. CPU seconds are of all stages, shared ones in full, "
    "and of those that differ between the three. COLMAP and evaluation are left out. PSNR is of held-out frames; where "
    "the lens is undistorted, of undistorted ones. "
    "Means are over the scenes that have the figure under all three settings."
)
FIGURES = (
    Column("cpu_s", "CPU", "s", 1),
    Column("differing_cpu_s", "CPU of what differs", "s", 1),
    Column("model_mb", "model", "MB", 2),
    Column("ate_percent", "ATE", "% of path", 3),
    Column("psnr_db", "PSNR", "dB", 2),
    Column("psnr_dynamic_db", "PSNR moving", "dB", 2),
)
COLUMNS = (
    Column("sequence", "scene"),
    Column("setting", "effects"),
    *FIGURES,
    Column("status", "path"),
    Column("effects", "modelled"),
)
PAIRS = (
    Column("sequence", "scene"),
    Column("time_share", "CPU, share of all", "", 2),
    Column("model_share", "model, share of all", "", 2),
    Column("psnr_db", "PSNR, minus all", "dB", 2),
    Column("psnr_dynamic_db", "PSNR moving, minus all", "dB", 2),
    Column("ate_ratio", "ATE, times all", "", 3),
    Column("psnr_none_db", "PSNR, minus none", "dB", 2),
    Column("psnr_dynamic_none_db", "PSNR moving, minus none", "dB", 2),
    Column("ate_none_ratio", "ATE, times none", "", 3),
)
TITLE = "Effects: decided, all and none"


def priced_part(costs: Sequence[Row]) -> tuple[str, list[Figure], list[Table]]:
    """The goals in sentences, the chart, and the tables of every scene; nothing if no sequence has all three runs.

    Args:
        costs: rows of the sweep's table.
    """
    scenes = priced.scenes_of(costs)
    if not scenes:
        return "", [], []
    sentence = " ".join(found.words() for found in priced.statements(scenes))
    source = embedding.data_uri(priced_chart.draw_priced(scenes, "svg"), "image/svg+xml")
    return sentence, [Figure(TITLE, source, in_words(scenes), wide=True)], [scene_table(scenes), pair_table(scenes)]


def in_words(scenes: Sequence[Scene]) -> str:
    """The content of the chart."""
    told = []
    for scene in scenes:
        pairs = [priced.against(run, scene.all) for run in (scene.decided, scene.none)]
        shares = " and ".join(f"{pair.time_share:.0%}, {priced.in_words(pair)}" for pair in pairs)
        told.append(f"{scene.sequence} {shares}")
    return f"CPU seconds, PSNR and ATE of the decided effects and of none against all effects: {'; '.join(told)}"


def scene_table(scenes: Sequence[Scene]) -> Table:
    """A row per scene and setting, and the means of every setting."""
    rows = [run for scene in scenes for run in scene.runs]
    averaged = [
        row | {"sequence": f"mean of {len(scenes)}", "is_total": True}
        for row in priced.means(scenes, [column.key for column in FIGURES])
    ]
    return Table("sweep_effects_scenes", f"{TITLE}, every scene", NOTE, COLUMNS, [*rows, *averaged])


def pair_table(scenes: Sequence[Scene]) -> Table:
    """The decided effects against all and against none, a row per scene."""
    rows = []
    for scene in scenes:
        close, better = priced.against(scene.decided, scene.all), priced.against(scene.decided, scene.none)
        none = {"psnr_none_db": better.psnr_db, "psnr_dynamic_none_db": better.psnr_dynamic_db}
        rows.append({"sequence": scene.sequence, **close._asdict(), **none, "ate_none_ratio": better.ate_ratio})
    note = "Decided effects: shares and ratios below 1 are cheaper or more accurate, differences above 0 better."
    return Table("sweep_effects_pairs", "Decided effects against all and none", note, PAIRS, rows)
