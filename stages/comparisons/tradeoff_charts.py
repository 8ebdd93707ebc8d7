"""Charts of accuracy against seconds and of growth with size."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stages.comparisons.growth import fit_growth
from stages.comparisons.tradeoff import Point, pareto_front
from stages.shared.charts import COLOURS, OTHERS, add_legend, figure

PALE = "#c4bfb9"
RIVAL_MARKERS = "s^DvPX<>"
DASHES = ("-", "--", "-.", (0, (1, 1)))
LARGEST = 4
"""Stages that each panel of the growth chart names."""


@dataclass(frozen=True)
class Measure:
    """A quantity on the vertical axis.

    Attributes:
        name: of the error, for sentences.
        label: of the axis.
        decibel: whether the axis shows PSNR, for points whose errors are RMS errors in percent of the range.
    """

    name: str
    label: str
    decibel: bool = False

    def shown(self, errors: Sequence[float]) -> np.ndarray:
        """Errors [n] converted to the quantity on the axis, [n]."""
        values = np.array(errors, float)
        return -20 * np.log10(values / 100) if self.decibel else values


def draw_overall(points: Sequence[Point], presets: Sequence[Point], rivals: Sequence[Point], measure: Measure) -> bytes:
    """All our settings with their Pareto front, the presets with labels, and COLMAP; hollow points are incomplete."""
    with figure((5.6, 4.2 + 0.1 * len(rivals)), "svg") as (fig, done):
        axes = fig.add_subplot()
        _scatter(axes, points, measure, PALE, 22, label="single knobs")
        front = pareto_front(points)
        x, y = [p.seconds for p in front], measure.shown([p.error for p in front])
        axes.step(x, y, where="post", color=COLOURS["ours"], lw=1.4, marker="o", ms=4, label="Pareto front")
        _scatter(axes, presets, measure, COLOURS["ours"], 44, "D", label="presets")
        for point in presets:
            _annotate(axes, point, measure)
        for k, rival in enumerate(rivals):
            _scatter(axes, [rival], measure, OTHERS[k % len(OTHERS)], 34, RIVAL_MARKERS[k % 8], label=rival.name)
        beside = "; COLMAP: CPU seconds of its one thread" if rivals else ""
        axes.set(xlabel=f"wall seconds{beside}", ylabel=measure.label, xscale="log")
        axes.margins(x=0.12, y=0.1)
        if not measure.decibel:
            axes.set_yscale("log")
            _plain_ticks(axes.yaxis)
        _plain_ticks(axes.xaxis)
        add_legend(axes)
    return done.getvalue()


def draw_knob(panels: Sequence[tuple[Measure, Sequence[Point]]]) -> bytes:
    """One knob, with a panel per measure: its values connected in order, the configured one in bold.

    An axis spans at least a tenth of the error, or half a decibel, so that smaller changes look small.
    """
    with figure((5.2, 2.7), "svg") as (fig, done):
        for k, (measure, values) in enumerate(panels):
            axes = fig.add_subplot(1, len(panels), k + 1)
            x, y = np.array([p.seconds for p in values]), measure.shown([p.error for p in values])
            axes.plot(x, y, color=COLOURS["ours"], lw=1.3)
            _scatter(axes, values, measure, COLOURS["ours"], 26)
            for point in values:
                _annotate(axes, point, measure)
            axes.set(xlabel="wall seconds", ylabel=measure.label)
            _span(axes.set_ylim, y, 0.5 if measure.decibel else 0.1 * float(y.mean()))
            _span(axes.set_xlim, x, 0.1 * float(x.mean()))
    return done.getvalue()


def draw_growth(series: Mapping[str, tuple[np.ndarray, np.ndarray]], labels: tuple[str, str]) -> bytes:
    """Values [k] over sizes [k] by stage, both logarithmic; fits are dashed lines, with exponents in the legend."""
    with figure((5.2, 4.2), "svg") as (fig, done):
        axes = fig.add_subplot()
        for k, (stage, (n, values)) in enumerate(series.items()):
            law = fit_growth(n, values)
            name = f"{stage}: {law.words().partition(' (')[0]}" if law else stage
            colour = (COLOURS["ours"], *OTHERS)[k % (len(OTHERS) + 1)]
            axes.plot(n, values, RIVAL_MARKERS[k % 8], ms=4, color=colour, label=name)
            if law:
                sizes = np.geomspace(n[0], n[-1], 40)
                axes.plot(sizes, law.at(sizes), "--", lw=1, color=colour)
        every = np.concatenate([values for _, values in series.values()])
        limits = every.min() / 1.2, every.max() * 1.2
        axes.set(xlabel=labels[0], ylabel=labels[1], xscale="log", ylim=limits, yscale="log")
        _plain_ticks(axes.xaxis)
        _plain_ticks(axes.yaxis)
        add_legend(axes, "exponents")
    return done.getvalue()


def draw_growths(
    panels: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]], axis: str, limits: Mapping[str, float]
) -> bytes:
    """Values [k] over sizes [k] by stage, a panel per measure, both axes logarithmic, as PNG.

    Stages differ in marker and dashes as well as in colour. The ones drawn are the largest of each panel; the last of
    its stages, the total over all, is drawn in bold.

    Args:
        panels: the series by label of the vertical axis; one without any is left out. axis: what grows.
        limits: a horizontal line by label of the panel.
    """
    largest = dict.fromkeys(stage for series in panels.values() for stage in _largest(series))
    with figure((3.7 * len(panels), 4.0), "png") as (fig, done):
        for k, (label, series) in enumerate((label, series) for label, series in panels.items() if series):
            axes = fig.add_subplot(1, len(panels), k + 1)
            total = list(series)[-1]
            for j, stage in enumerate(largest):
                colour = (*OTHERS, COLOURS["ours"])[j % (len(OTHERS) + 1)]
                style = {"color": colour, "ls": DASHES[j % len(DASHES)], "marker": RIVAL_MARKERS[j % 8]}
                n, values = series.get(stage, ([], []))
                axes.plot(n, values, ms=5, lw=1.3, label=stage, **style)
            axes.plot(*series[total], color=COLOURS["truth"], lw=2.6, marker="o", ms=6, label=total)
            sizes = series[total][0]
            axes.set(xlabel=axis, title=label, xscale="log", yscale="log", xticks=sizes)
            axes.set_xticklabels([f"{size:g}" for size in sizes])
            axes.xaxis.minorticks_off()
            if label in limits:
                axes.axhline(limits[label], color=COLOURS["truth"], lw=1, ls=":")
                axes.annotate(f"goal: {limits[label]:g}", (sizes[0], limits[label]), fontsize=9, va="bottom")
            _plain_ticks(axes.yaxis)
            axes.tick_params(labelsize=9)
        handles, names = axes.get_legend_handles_labels()
        fig.legend(handles, names, loc="outside lower center", ncols=len(names), fontsize=9)
    return done.getvalue()


def _largest(series: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> list[str]:
    """The stages, without the last, which is the total, with the LARGEST highest values at the largest size."""
    stages = list(series)[:-1]
    return sorted(stages, key=lambda stage: -series[stage][1][-1])[:LARGEST]


def _scatter(
    axes: Any, points: Sequence[Point], measure: Measure, colour: str, size: float, marker: str = "o", label: str = ""
) -> None:
    x, y = [p.seconds for p in points], measure.shown([p.error for p in points])
    faces = [colour if p.complete else "white" for p in points]
    style = {"edgecolors": colour, "marker": marker, "linewidths": 1, "zorder": 3, "label": label or None}
    axes.scatter(x, y, s=size, c=faces, **style)


def _annotate(axes: Any, point: Point, measure: Measure) -> None:
    weight = "bold" if point.is_default else "normal"
    place = point.seconds, measure.shown([point.error])[0]
    style = {"fontsize": 9, "fontweight": weight, "textcoords": "offset points", "xytext": (5, 5)}
    axes.annotate(point.label, place, **style)


def _span(set_limits: Any, values: np.ndarray, least: float) -> None:
    """Set limits around the values, with room for labels and at least `least` apart."""
    middle, half = (values.min() + values.max()) / 2, max(float(np.ptp(values)), least) / 2
    set_limits(middle - 1.3 * half, middle + 1.6 * half)


def _plain_ticks(axis: Any) -> None:
    """Set labels 1, 2, 5, 10 ... on a logarithmic axis, with k for thousands."""
    from matplotlib import ticker

    axis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(ticker.FuncFormatter(lambda v, _: f"{v / 1000:g}k" if v >= 1000 else f"{v:g}"))
    axis.set_minor_formatter(ticker.NullFormatter())
