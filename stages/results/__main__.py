"""The page of results: the scores of one run on every scene.

    python -m stages.results --results results/<dataset> --output results.md

writes it for the evaluated results of any dataset; `make results` runs the whole scene library first.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from stages.comparisons import made_under, tradeoff
from stages.evaluate import summaries
from stages.evaluate.score_images import SPLITS
from stages.report import paired_report, provenance, tradeoff_report
from stages.results import scene_tables
from stages.results.blocks import made_by, with_block
from stages.results.options import ResultsOptions
from stages.results.scene_tables import PARTS
from stages.results.scorecard import score_rows
from stages.shared import cli
from stages.shared.atomic import atomic
from stages.shared.cli import In, Out
from stages.shared.errors import InputError
from stages.shared.tables import Column, Row, Table, read_rows

BEGIN, END = "<!-- results:begin -->", "<!-- results:end -->"
DEMO = "demo"
TIMES = (
    *(Column("stage", "stage"), Column("round", "round"), Column("threads", "threads")),
    *(Column("wall_s", "wall", "s", 1), Column("cpu_s", "CPU", "s", 1), Column("peak_mb", "peak memory", "MB", 0)),
)
ABOUT = """\
The tables list every scene of the run, failed ones too. Camera error: ATE in % of the camera's path after Sim(3)
alignment; if the camera rests or moves on a straight line, which defines no ATE, the rotation error from frame to frame
in degrees. COLMAP: the best of the variants that were run without masks. Medians and means are over the scenes that
have the figure, flagged ones included; errors of partial and failed paths are excluded and counted. Seconds to poses:
from flow to adjustment, all rounds; for COLMAP features, matching and mapping. Mask scores: IoU is a mean over frames,
precision and recall are over the pixels of all frames; if nothing moves, the share of masked pixels is given. Masks
follow things over the whole clip: "movers at rest too" is the IoU with all that moves in any frame, also where it
rests."""


def main(
    results: Annotated[Path, In("results/<dataset>, evaluated")],
    output: Annotated[Path, Out("the page, Markdown")],
    options: ResultsOptions,
    readme: Annotated[Path | None, In("file whose lines between the two marks are replaced by the summary")] = None,
    scenes: Annotated[Path | None, In("folder of the scene files of the run; a scene without results failed")] = None,
    manifests: Annotated[Path | None, In("folder of the simulator's manifests, <sequence>.json")] = None,
) -> str:
    """Write the page of results from the tables of an evaluation, and its summary into the README."""
    rows = score_rows(results, scenes, manifests)
    if not rows:
        raise InputError(results, "a result folder with sequences", "none", "name a folder results/<dataset>")
    block = summary(rows, options.command)
    with atomic(output) as partial:
        partial.write_text(page(rows, block, results))
    if readme:
        text = with_block(readme, block, (BEGIN, END))
        with atomic(readme) as partial:
            partial.write_text(text)
    return f"{len(rows)} sequences"


def summary(rows: Sequence[Row], command: str) -> str:
    """The lines between the marks: provenance, counts, and the headline figures of each part."""
    parts = scene_tables.parts_of(rows)
    lines = [f"{made_by(command)}; {threads_of(rows)}.", ""]
    lines += [f"- {PARTS[split]}: {scene_tables.counts(part)}" for split, part in parts.items()]
    table = scene_tables.figure_table(parts, scene_tables.HEADLINE)
    return "\n".join([BEGIN, *lines, "", table.markdown(), END])


def threads_of(rows: Sequence[Row]) -> str:
    """The numbers of threads of our stages and of COLMAP, in words."""
    ours, colmap = (
        max((row[key] for row in rows if row.get(key)), default=None) for key in ("threads", "colmap_threads")
    )
    most = "1 thread" if ours == 1 else f"at most {ours} threads"
    return f"our stages on {most}, COLMAP on {colmap or 'none: it did not run'}"


def page(rows: Sequence[Row], block: str, results: Path) -> str:
    """The page as Markdown; `block` is the summary."""
    folders = [results / row["sequence"] for row in rows if (results / row["sequence"] / "sequence.json").exists()]
    about = [f"- {name}: {value}" for name, value in provenance.about_run().items()]
    written = f"Written by `python -m stages.results` from the tables in `{results.name}`; not edited by hand."
    parts = scene_tables.parts_of(rows)
    chunks = ["# Results", written, block, ABOUT, f"{SPLITS['test'].capitalize()}.", "## Where they come from"]
    chunks.append("\n".join([*about, f"- threads: {threads_of(rows)}"]))
    for split, part in parts.items():
        chunks += [f"## {PARTS[split]}", scene_tables.counts(part)]
        for table in (scene_tables.camera_table(part), scene_tables.view_table(part)):
            chunks += [f"### {table.title}", table.markdown()]
    chunks += ["## Medians and means", scene_tables.figure_table(parts).markdown(), *_demo_times(results)]
    chunks += [*_sweep(results), *_options(folders)]
    return "\n\n".join(chunks) + "\n"


def _demo_times(results: Path) -> list[str]:
    """The section with the seconds of every stage on the demo; empty if the demo is not among the scenes."""
    times = results / DEMO / "eval/time.parquet"
    if not times.exists():
        return []
    table = Table("time", "", "", TIMES, summaries.time_means(read_rows(times)))
    note = "In the run above, kernels compiled and other scenes side by side; without Snakemake's own time."
    return ["## Seconds of every stage on the demo", note, table.markdown()]


def _sweep(results: Path) -> list[str]:
    """The section of the sweep that belongs to this run; a sentence if there is none, or if it is of another run."""
    title, table = "## Presets, inputs and claims", results / "sweep/costs.parquet"
    if not table.exists():
        return [title, "There is no sweep for this run; `snakemake sweep` makes one."]
    changes = made_under.differences(table, results)
    if changes:
        return [title, f"The sweep in this folder was made under other options or code: {'; '.join(changes)}."]
    costs = read_rows(table)
    names = ", ".join(dict.fromkeys(row["sequence"] for row in costs))
    chunks = [title, f"Means over {names}. {tradeoff_report.NOTE}"]
    for part in [*tradeoff_report.group_tables(tradeoff.means(costs)), *paired_report.paired_tables(costs)]:
        chunks += [f"### {part.title}", part.markdown()]
    return chunks


def _options(folders: Sequence[Path]) -> list[str]:
    """The section with the options of every stage."""
    columns = (Column("stage", "stage"), Column("sequences", "scenes"), Column("options", "options"))
    finished = [folder for folder in folders if (folder / "stats").is_dir()]
    return ["## Options of every stage", Table("options", "", "", columns, provenance.option_rows(finished)).markdown()]


if __name__ == "__main__":
    cli.run(main)
