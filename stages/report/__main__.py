"""The report: one self-contained HTML page over all sequences, with each of its tables as CSV and Parquet."""

from pathlib import Path
from typing import Annotated, Any

import jinja2
import markupsafe
import yaml

from stages.comparisons import made_under
from stages.evaluate import pose_statistics
from stages.report import overview, paired_report, priced_report, provenance, tradeoff_report
from stages.report.clips import clip_of, shot_lines
from stages.report.effect_tables import decision_rows, simulation_rows
from stages.report.options import ReportOptions
from stages.report.overview import Group
from stages.report.scene_pages import find_scene_pages
from stages.report.sections import Section, build_section
from stages.shared import cli
from stages.shared.artifacts import read_metadata
from stages.shared.atomic import atomic, atomic_folder
from stages.shared.cli import In, Out
from stages.shared.log import logger, progress
from stages.shared.tables import Row, Table, read_rows

TEMPLATES = Path(__file__).parent / "templates"
ASSETS = {"style": "style.css", "script": "sort.js", "scene_script": "scene.js"}
KINDS = ("poses", "images", "masks", "checks", "time")
SECTION_TABLES = ("poses", "adjustment", "images", "masks", "checks", "time", "decisions", "simulation")
FOLDED_TABLES = ("statistics",)


def main(
    sequences: Annotated[list[Path], In("result folders of the sequences")],
    published_numbers: Annotated[Path, In("numbers of other methods, with source and protocol")],
    output: Annotated[Path, Out("the page")],
    tables: Annotated[Path, Out("folder for the tables as CSV and Parquet")],
    options: ReportOptions,
    manifests: Annotated[Path | None, In("folder of the simulator's manifests, <sequence>.json")] = None,
    sweep: Annotated[Path | None, In("table of the sweep: accuracy and cost of every setting")] = None,
    growth: Annotated[Path | None, In("table of the scaling: cost of every stage over sizes")] = None,
) -> str:
    """Write the report. The page needs neither network nor other files; missing results are left out.

    It only links to 4D scenes for which it has no room.
    """
    rows, protocols = gather(sequences, manifests)
    names = [folder.name for folder in sequences]
    swept = [row for row in read_rows(sweep) if row["sequence"] in names] if sweep else []
    earlier = {"tradeoff": sweep, "growth": growth}
    changes = {name: made_under.differences(table, sequences[0].parent) for name, table in earlier.items() if table}
    rows["settings"] = [] if changes.get("tradeoff") else swept  # an outdated sweep enters no table of the run
    rows["poses"] = with_settings(rows["poses"], rows["settings"], names)
    compared = [overview.outdated(g, changes[g.name]) for g in comparison_groups(swept, growth, rows["poses"])]
    groups = overview.build_groups(rows, protocols, yaml.safe_load(published_numbers.read_text()))
    groups[-1:-1] = compared
    every = {table.name: table for group in groups for table in [*group.tables, *group.more]}
    about = provenance.tables(sequences)
    written = [*every.values(), *about]
    with atomic_folder(tables, [f"{table.name}.*" for table in written]) as target:
        for table in written:
            table.write(target)
    sections = build_sections(sequences, every)
    page = render(
        title=options.title,
        summary=overview.summary(rows),
        tiles=overview.tiles(rows),
        clips=shot_lines(sequences),
        given=given_lines(sequences),
        problems=overview.problems(rows, names),
        groups=groups,
        sections=sections,
        scenes=find_scene_pages(sequences, sections, output),
        provenance=about,
    )
    with atomic(output) as partial:
        partial.write_text(page, encoding="utf-8")
    logger.info("report: %s, %.1f MB", output, len(page.encode()) / 1e6)
    return f"{len(names)} sequence{'s' if len(names) > 1 else ''}"


def build_sections(folders: list[Path], tables: dict[str, Table]) -> list[Section]:
    """A section per sequence; if there are several, each has its own rows of the tables."""
    shown = []
    for folder in progress(folders, "sequences"):
        section = build_section(folder)
        if len(folders) > 1:
            section.tables, section.more = (
                [own for name in names if name in tables and (own := tables[name].of(section.name)).rows]
                for names in (SECTION_TABLES, FOLDED_TABLES)
            )
        shown.append(section)
    return shown


def given_lines(folders: list[Path]) -> list[str]:
    """What the user handed in for each sequence, in words; without a sequence for which it is nothing."""
    lines = []
    for folder in folders:
        checks = folder / "eval/checks.parquet"
        if checks.exists() and (words := read_metadata(checks).get("given")):
            lines.append(f"{folder.name}: {words}" if len(folders) > 1 else words)
    return lines


def with_settings(poses: list[Row], settings: list[Row], names: list[str]) -> list[Row]:
    """The pose rows and those of the sweep, in the order of `names`."""
    rows = [*poses, *tradeoff_report.pose_rows(settings, poses)]
    return sorted(rows, key=lambda row: names.index(row["sequence"]))


def comparison_groups(settings: list[Row], growth: Path | None, poses: list[Row]) -> list[Group]:
    """The groups of the sweep and of the scaling, if these were run."""
    groups = []
    if settings:
        sentence, figures, tables = tradeoff_report.sweep_part(settings, poses)
        tables += paired_report.paired_tables(settings)
        told, charts, of_effects = priced_report.priced_part(settings)
        more = tradeoff_report.sequence_tables(settings)
        sentence, tables, figures = f"{sentence} {told}".strip(), [*tables, *of_effects], [*figures, *charts]
        groups.append(Group("tradeoff", "Accuracy against time", tables, more, figures, sentence))
    if growth:
        figures, tables = tradeoff_report.growth_part(read_rows(growth))
        groups.append(Group("growth", "Growth of time and memory", tables, [], figures))
    return groups


def gather(folders: list[Path], manifests: Path | None) -> tuple[dict[str, list[Row]], dict[str, str]]:
    """Rows of all sequences, and the protocol, by kind of table; missing tables are left out."""
    rows: dict[str, list[Row]] = {kind: [] for kind in KINDS}
    protocols = dict.fromkeys(KINDS, "")
    for kind in KINDS:
        for path in (folder / "eval" / f"{kind}.parquet" for folder in folders):
            if path.exists():
                rows[kind] += read_rows(path)
                protocols[kind] = read_metadata(path).get("protocol", "")
    rows["decisions"] = [row for folder in folders for row in decision_rows(folder)]
    rows["statistics"] = [row for folder in folders for row in pose_statistics.statistic_rows(folder)]
    rows["simulation"] = [row for folder in folders for row in simulation_rows(manifests, folder.name, clip_of(folder))]
    return rows, protocols


def render(**content: Any) -> str:
    """The page as HTML, from the template; text is escaped, style and script are inserted unchanged."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES), autoescape=True, undefined=jinja2.StrictUndefined
    )
    parts = {name: markupsafe.Markup((TEMPLATES / file).read_text()) for name, file in ASSETS.items()}
    return environment.get_template("report.html.j2").render(**content, **parts)


if __name__ == "__main__":
    cli.run(main)
