"""Draw the files that rules pass to each other, as Snakemake plans them: docs/dataflow.png.

A row per rule: its name and script in a box, and its files on lines that leave to the right and turn down. An arrow
into a box comes from all files that the rule reads, marked by dots.
"""

import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from stages.shared import cli
from stages.shared.artifacts import atomic
from stages.shared.cli import Out

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

REPO = Path(__file__).parents[1]
PLAN = ("-n", "-p", "sweep", "scaling", "--configfile")
OPTIONS = {"dataset": "simulated", "scenes": ["demo"], "colmap": {"upsample_masked": [1]}}
"""All rules, on one scene of the library."""
LEFT_OUT = ("stats/", "figures/")
"""Folders of files that every rule writes besides its artifacts: time files, and pictures for the report."""
WIDTH_PX, BOX_PX, TEXT_PX, LANE_PX, ROW_PX, GAP_PX, TOP_PX = 1040, 168, 186, 21, 17, 13, 14
COLOURS = ("#1f77b4", "#d95f02", "#1b9e77", "#a6408f", "#8c6d1f", "#c0392b", "#2c5f8a", "#5a8f29")
BAND = "#f1f1ea"


@dataclass(eq=False)
class Rule:
    """A rule with the outputs and inputs of all of its jobs.

    Attributes:
        script: the module that it runs, "" for one that runs none.
        outputs: names of its artifacts within the folder of a sequence or of the dataset, in the rule's order.
        inputs: artifacts that it reads. before: those that it reads from the round before.
        repeated: whether rounds repeat it. jobs: the text of the dry run on each of its jobs.
    """

    name: str
    script: str
    outputs: list[str] = field(default_factory=list)
    inputs: list[str] = field(default_factory=list)
    before: list[str] = field(default_factory=list)
    repeated: bool = False
    jobs: list[str] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class Lane:
    """Artifacts of one rule that the same rules read: one line in the picture."""

    maker: Rule
    artifacts: tuple[str, ...]
    readers: tuple[str, ...]
    before: tuple[str, ...]

    @property
    def label(self) -> str:
        """The file names, with their common part written once."""
        folders = {name.rpartition("/")[0] for name in self.artifacts}
        suffixes = {Path(name).suffix for name in self.artifacts}
        if len(self.artifacts) < 3 or len(folders) > 1 or len(suffixes) > 1:
            return ", ".join(self.artifacts)
        return f"{folders.pop()}/{{{', '.join(Path(name).stem for name in self.artifacts)}}}{suffixes.pop()}"


def main(output: Annotated[Path, Out("picture, e.g. docs/dataflow.png")]) -> None:
    """Draw the flow of data between the rules of the workflow.

    The picture carries what it shows as text ("Description"), so that a test can tell whether it is still true.
    """
    from PIL import Image, PngImagePlugin

    rules = planned_rules()
    figure = draw(rules)
    figure.canvas.draw()
    about = PngImagePlugin.PngInfo()
    about.add_text("Description", described(rules))
    image = Image.frombuffer("RGBA", figure.canvas.get_width_height(), figure.canvas.buffer_rgba())  # type: ignore[attr-defined]
    with atomic(output) as partial:
        image.convert("RGB").quantize(64, dither=Image.Dither.NONE).save(partial, "PNG", optimize=True, pnginfo=about)


def planned_rules() -> list[Rule]:
    """Every rule that makes a file, readers after makers, from a dry run of the workflow in an empty folder."""
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(REPO / "Snakefile")]
    with tempfile.TemporaryDirectory() as folder:
        asked = Path(folder) / "asked.json"
        asked.write_text(json.dumps(OPTIONS))
        command += ["--directory", folder, *PLAN, str(asked)]
        plan = subprocess.run(command, cwd=REPO, capture_output=True, text=True, check=True)
    return _in_order(_read_plan(plan.stdout + plan.stderr))


def described(rules: Iterable[Rule]) -> str:
    """One line per rule: what it runs, reads and writes."""
    lines = []
    for rule in rules:
        read = ", ".join(sorted(rule.inputs) + [f"{name} of the round before" for name in sorted(rule.before)])
        lines.append(f"{rule.name} ({rule.script}): {read} -> {', '.join(rule.outputs)}")
    return "\n".join(lines)


def lanes_of(rules: Sequence[Rule]) -> list[Lane]:
    """The lines of the picture, in the order of their makers."""
    lanes: dict[tuple[str, ...], Lane] = {}
    for rule in rules:
        for name in rule.outputs:
            readers = tuple(other.name for other in rules if name in other.inputs)
            before = tuple(other.name for other in rules if name in other.before)
            key = (rule.name, *readers, "before", *before)
            together = lanes[key].artifacts if key in lanes else ()
            lanes[key] = Lane(rule, (*together, name), readers, before)
    return list(lanes.values())


def draw(rules: Sequence[Rule]) -> "Figure":
    """The picture, at twice the size at which it is shown."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    lanes = lanes_of(rules)
    rows: dict[str, float] = {}
    y = float(TOP_PX)
    for rule in rules:
        rows[rule.name] = y
        y += ROW_PX * (1 + sum(lane.maker is rule for lane in lanes)) + GAP_PX
    figure = Figure(figsize=(WIDTH_PX / 100, y / 100), dpi=200)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, WIDTH_PX), ylim=(y, 0))
    axes.axis("off")
    colours = {rule.name: COLOURS[k % len(COLOURS)] for k, rule in enumerate(rules)}
    _draw_rounds(axes, rules, rows, lanes)
    drawn = [lane for lane in lanes if lane.readers or lane.before]
    at = {lane: float(WIDTH_PX - 14 - LANE_PX * k) for k, lane in enumerate(drawn)}
    for rule in rules:
        own = [lane for lane in lanes if lane.maker is rule]
        _draw_inputs(axes, rule, rows[rule.name] + ROW_PX / 2, at, colours)
        for k, lane in enumerate(own, start=1):
            _draw_lane(axes, lane, rows[rule.name] + ROW_PX * (k + 0.5), rows, at.get(lane), colours[rule.name])
        _draw_box(axes, rule, rows[rule.name], ROW_PX * (1 + len(own)), colours[rule.name])
    return figure


def _draw_rounds(axes: "Axes", rules: Sequence[Rule], rows: dict[str, float], lanes: Sequence[Lane]) -> None:
    """A band behind the rules that rounds repeat."""
    repeated = [rule for rule in rules if rule.repeated]
    top = min(rows[rule.name] for rule in repeated) - GAP_PX / 2
    bottom = max(rows[r.name] + ROW_PX * (1 + sum(lane.maker is r for lane in lanes)) for r in repeated) + GAP_PX / 2
    axes.axhspan(top, bottom, color=BAND, zorder=0)
    note = "repeated `rounds` times; dashed: from the round before"
    axes.text(TEXT_PX, top + 4, note, fontsize=6.6, style="italic", color="#666666", va="top")


def _draw_box(axes: "Axes", rule: Rule, top: float, height: float, colour: str) -> None:
    from matplotlib.patches import FancyBboxPatch

    shape = "round,pad=0,rounding_size=4"
    axes.add_patch(FancyBboxPatch((8, top), BOX_PX - 8, height, shape, fc="white", ec=colour, lw=1.4, zorder=4))
    middle = top + height / 2
    axes.text(18, middle - 7, rule.name, fontsize=8.2, weight="bold", va="center", zorder=5)
    axes.text(18, middle + 7, rule.script or "(in the workflow)", fontsize=6.4, color="#555555", va="center", zorder=5)


def _draw_inputs(axes: "Axes", rule: Rule, y: float, at: dict[Lane, float], colours: dict[str, str]) -> None:
    """The arrow into a box, with a dot on every line that it reads."""
    read = {x: lane for lane, x in at.items() if rule.name in (*lane.readers, *lane.before)}
    if not read:
        return
    arrow = {
        "arrowstyle": "-|>,head_width=0.16,head_length=0.3",
        "color": "#444444",
        "lw": 0.9,
        "shrinkA": 0,
        "shrinkB": 0,
    }
    axes.annotate("", (BOX_PX, y), (max(read), y), arrowprops=arrow, zorder=2)
    for x, lane in read.items():
        again = rule.name in lane.before
        face = "white" if again and rule.name not in lane.readers else colours[lane.maker.name]
        axes.plot([x], [y], "o", ms=3.6, mfc=face, mec=colours[lane.maker.name], mew=0.9, zorder=6)


def _draw_lane(axes: "Axes", lane: Lane, y: float, rows: dict[str, float], x: float | None, colour: str) -> None:
    """The arrow that leaves a box with its file names, down to the last reader and up to those of the next round."""
    end = x if x is not None else TEXT_PX - 6
    axes.plot([BOX_PX, end], [y, y], color=colour, lw=1.1, zorder=1, solid_capstyle="round")
    readers = [rows[name] + ROW_PX / 2 for name in lane.readers]
    if readers:
        axes.plot([end, end], [y, max(readers)], color=colour, lw=1.1, zorder=1)
    if lane.before:
        top = min(rows[name] for name in lane.before) + ROW_PX / 2
        axes.plot([end, end], [y, top], color=colour, lw=1.1, ls=(0, (3, 2)), zorder=1)
    box = {"fc": BAND if lane.maker.repeated else "white", "ec": "none", "pad": 1.2}
    axes.text(TEXT_PX, y, lane.label, fontsize=7.2, family="monospace", va="center", bbox=box, zorder=3)


def _read_plan(text: str) -> dict[str, Rule]:
    """The rules in the words of a dry run, merged over the jobs of the configured run; a sweep's others are alike."""
    jobs = sorted(re.split(r"^ *(?=(?:local)?rule \w+:)", text, flags=re.MULTILINE)[1:])
    rules: dict[str, Rule] = {}
    for job in jobs:
        name, made = job.partition(":")[0].split()[-1], _listed(job, "output").split(", ")
        if any(map(_artifact, made)) and "/settings/" not in made[0]:
            script = re.search(r"python -m (stages[\w.]+)", job)
            rule = rules.setdefault(name, Rule(name, script[1] if script else ""))
            _add(rule.outputs, map(_artifact, made))
            rule.jobs.append(job)
    known = {artifact for rule in rules.values() for artifact in rule.outputs}
    for rule in rules.values():
        rule.repeated = any(_round(_listed(job, "output")) for job in rule.jobs)
        for job in rule.jobs:
            for path in _listed(job, "input").split(", "):
                again = rule.repeated and _round(path) not in ("", _round(_listed(job, "output")))
                _add(rule.before if again else rule.inputs, {_artifact(path)} & known)
    return rules


def _listed(job: str, kind: str) -> str:
    """The paths of a job, "input" or "output", as the dry run lists them."""
    found = re.search(rf"^ +{kind}: (.*)$", job, re.MULTILINE)
    return found[1] if found else ""


def _round(path: str) -> str:
    found = re.search(r"/(round\d+)/", path)
    return found[1] if found else ""


def _artifact(path: str) -> str:
    """The name of a file within the folder of its sequence or dataset; "" for files that are not drawn."""
    name = re.sub(r"settings/[^/]+/|round\d+/", "", path.removeprefix("results/simulated/").removeprefix("demo/"))
    name = name.replace("demo.json", "<sequence>.json")
    return "" if name.startswith(LEFT_OUT) else name if Path(name).suffix or not name else f"{name}/"


def _add(names: list[str], more: Iterable[str]) -> None:
    names += [name for name in dict.fromkeys(more) if name and name not in names]


def _in_order(rules: dict[str, Rule]) -> list[Rule]:
    """Readers after makers, and every rule as late as its readers allow."""
    maker = {artifact: rule.name for rule in rules.values() for artifact in rule.outputs}
    makers = {rule.name: list(dict.fromkeys(maker[artifact] for artifact in rule.inputs)) for rule in rules.values()}
    distance = dict.fromkeys(rules, 0)
    for _ in rules:  # as often as the longest path may have steps
        for name, before in makers.items():
            for other in before:
                distance[other] = max(distance[other], distance[name] + 1)
    return sorted(rules.values(), key=lambda rule: (-distance[rule.name], rule.name))


if __name__ == "__main__":
    cli.run(main)
