"""Draw the files that rules pass to each other, as Snakemake plans them: docs/dataflow.png.

A row per rule: its name and script in a box, and its files on lines that leave to the right and turn down. An arrow
into a box comes from all files that the rule reads, marked by dots.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from stages.shared import cli
from stages.shared.atomic import atomic
from stages.shared.cli import Out
from workflow.dry_run import Rule, described, planned_rules

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH_PX, BOX_PX, TEXT_PX, LANE_PX, ROW_PX, GAP_PX, TOP_PX = 1040, 168, 186, 21, 17, 13, 14
COLOURS = ("#1f77b4", "#d95f02", "#1b9e77", "#a6408f", "#8c6d1f", "#c0392b", "#2c5f8a", "#5a8f29")
BAND = "#f1f1ea"


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


if __name__ == "__main__":
    cli.run(main)
