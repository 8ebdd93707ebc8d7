"""The page on the price of effects: decided, all and none on every scene of a sweep.

    python -m stages.results.priced --results results/<dataset> --output priced.md --chart priced.png

writes it for the sweep of any dataset; `make priced` runs the three settings on the scene library first.
"""

import itertools
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

from stages.comparisons import priced, priced_chart, sweep
from stages.comparisons.priced import Scene
from stages.configuration.compared_runs import needed_files
from stages.report import priced_report
from stages.results.blocks import made_by, with_block
from stages.results.options import ResultsOptions
from stages.results.scorecard import is_current
from stages.shared import cli
from stages.shared.artifacts import read_json
from stages.shared.atomic import atomic
from stages.shared.chain import STAGES
from stages.shared.cli import In, Out
from stages.shared.errors import InputError
from stages.shared.tables import Row

MARKS = "<!-- priced:begin -->", "<!-- priced:end -->"


def main(
    results: Annotated[Path, In("results/<dataset>, with a sweep over the group effects")],
    output: Annotated[Path, Out("the page, Markdown")],
    chart: Annotated[Path, Out("the chart, PNG")],
    options: ResultsOptions,
    readme: Annotated[Path | None, In("file whose lines between two marks are replaced by the goals and chart")] = None,
) -> str:
    """Write the page and the chart from the finished runs of a sweep, and goals and chart into the README.

    Scenes that lack results of one of the three settings are named and left out.
    """
    runs = [run for run in _listed(results) if run["group"] == priced.GROUP]
    scenes = priced.scenes_of([sweep.run_row(results, run) for run in runs if _is_finished(results, run)])
    if not scenes:
        expected = f"a sequence with results under {', '.join(priced.SETTINGS)}"
        raise InputError(results, expected, "none", "run `make priced`, or `snakemake sweep` with the group effects")
    names = dict.fromkeys(str(run["sequence"]) for run in runs)
    missing = [name for name in names if name not in {scene.sequence for scene in scenes}]
    told = summary(scenes, missing, _older(results, scenes), options.command)
    with atomic(chart) as partial:
        partial.write_bytes(priced_chart.draw_priced(scenes, "png"))
    with atomic(output) as partial:
        partial.write_text(page(scenes, block(told, scenes, chart, output)))
    if readme:
        text = with_block(readme, block(told, scenes, chart, readme), MARKS)
        with atomic(readme) as partial:
            partial.write_text(text)
    return f"{len(scenes)} sequences, {len(missing)} unfinished"


def _listed(results: Path) -> list[Row]:
    path = results / "sweep/runs.json"
    if not path.exists():
        raise InputError(path, "the list of runs of a sweep", "no such file", "run `make priced`")
    listed: list[Row] = read_json(path)["runs"]
    return listed


def _is_finished(results: Path, run: Row) -> bool:
    return all((results / path).exists() for path in needed_files(run))


def _older(results: Path, scenes: Sequence[Scene]) -> list[str]:
    """The scenes of which a stage, under one of the settings, ran with other code than this checkout's."""
    folders = "", "round*/", f"settings/{priced.GROUP}-*/", f"settings/{priced.GROUP}-*/round*/"

    def stats(sequence: str) -> Iterator[Path]:
        for name, stage in itertools.product(folders, STAGES):
            yield from (results / sequence).glob(f"{name}stats/{stage}.json")

    return [scene.sequence for scene in scenes if not all(map(is_current, stats(scene.sequence)))]


def summary(scenes: Sequence[Scene], missing: Sequence[str], older: Sequence[str], command: str) -> str:
    """Where the figures come from, what is left out, and the three goals."""
    lines = [f"{made_by(command)}; {len(scenes)} scene{'s' * (len(scenes) != 1)}.", ""]
    lines += [f"Without results of all three settings, and left out: {', '.join(missing)}.", ""] if missing else []
    lines += [f"Made by other code than that of this commit: {', '.join(older)}.", ""] if older else []
    return "\n".join([*lines, *(f"- {found.words()}" for found in priced.statements(scenes))])


def block(told: str, scenes: Sequence[Scene], chart: Path, beside: Path) -> str:
    """The summary and the chart between the marks; the path of the chart is relative to the file that shows it."""
    path = os.path.relpath(chart.resolve(), beside.resolve().parent)
    return "\n".join([MARKS[0], told, "", f"![{priced_report.in_words(scenes)}]({path})", MARKS[1]])


def page(scenes: Sequence[Scene], shown: str) -> str:
    """The page as Markdown; `shown` is the block with summary and chart."""
    written = "Written by `python -m stages.results.priced`; not edited by hand."
    chunks = ["# The price of effects", written, shown, priced_report.NOTE]
    for table in (priced_report.scene_table(scenes), priced_report.pair_table(scenes)):
        chunks += [f"## {table.title}", table.markdown()]
    return "\n\n".join(chunks) + "\n"


if __name__ == "__main__":
    cli.run(main)
