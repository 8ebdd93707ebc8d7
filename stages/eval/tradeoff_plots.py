"""Charts of accuracy against seconds and of growth with size, as SVG."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stages.eval.growth import fit_power_law
from stages.eval.plots import COLOURS, LEGEND, OTHERS, figure
from stages.eval.tradeoff import Point, pareto_front

PALE = "#c4bfb9"


@dataclass(frozen=True)
class Measure:
    """What stands on the vertical axis.

    Attributes:
        name: of the error, as a sentence needs it.
        label: of the axis.
        decibel: the points' errors are RMS errors in percent of the range; the axis shows PSNR.
    """

    name: str
    label: str
    decibel: bool = False

    def shown(self, errors: Sequence[float]) -> np.ndarray:
        """Errors as the axis shows them."""
        values = np.array(errors, float)
        return -20 * np.log10(values / 100) if self.decibel else values


def draw_overall(points: Sequence[Point], presets: Sequence[Point], rivals: Sequence[Point], measure: Measure) -> bytes:
    """All our settings and their Pareto front, the presets and COLMAP labelled; hollow: incomplete."""
    with figure((7.2, 4.4), "svg") as (fig, done):
        axes = fig.add_subplot()
        front = pareto_front(points)
        _scatter(axes, points, measure, PALE, 22)
        x, y = [p.seconds for p in front], measure.shown([p.error for p in front])
        axes.step(x, y, where="post", color=COLOURS["ours"], lw=1.4, marker="o", ms=4, label="Pareto front")
        _scatter(axes, rivals, measure, OTHERS[0], 30, "s")
        _scatter(axes, presets, measure, COLOURS["ours"], 40, "D")
        for point in [*presets, *rivals]:
            _annotate(axes, point, measure)
        _finish(axes, measure)
        axes.set_xscale("log")
        axes.margins(x=0.16, y=0.12)
        axes.legend(**LEGEND)
    return done.getvalue()


def draw_knob(panels: Sequence[tuple[Measure, Sequence[Point], Sequence[Point]]]) -> bytes:
    """One knob, a panel per measure: its values joined in order over all other settings (pale)."""
    with figure((5.2, 2.7), "svg") as (fig, done):
        for k, (measure, values, others) in enumerate(panels):
            axes = fig.add_subplot(1, len(panels), k + 1)
            _scatter(axes, others, measure, PALE, 9)
            x, y = [p.seconds for p in values], measure.shown([p.error for p in values])
            axes.plot(x, y, color=COLOURS["ours"], lw=1.3)
            _scatter(axes, values, measure, COLOURS["ours"], 26)
            for point in values:
                _annotate(axes, point, measure)
            _finish(axes, measure)
            axes.margins(x=0.2, y=0.2)
    return done.getvalue()


def draw_growth(series: Mapping[str, tuple[np.ndarray, np.ndarray]], labels: tuple[str, str]) -> bytes:
    """Values by stage over the size, both logarithmic; dashed: the fitted power laws."""
    with figure((5.2, 3.6), "svg") as (fig, done):
        axes = fig.add_subplot()
        for k, (stage, (n, values)) in enumerate(series.items()):
            law = fit_power_law(n, values)
            name = f"{stage}: {law.exponent:.2f}" if law else stage
            colour = (COLOURS["ours"], *OTHERS)[k % (len(OTHERS) + 1)]
            marker = "os^Dv"[(k // (len(OTHERS) + 1)) % 5]
            axes.plot(n, values, marker, ms=4, color=colour, label=name)
            if law:
                axes.plot(n, law.at(n), "--", lw=1, color=colour)
        axes.set(xlabel=labels[0], ylabel=labels[1], xscale="log", yscale="log")
        axes.legend(**LEGEND | {"ncols": 3, "title": "exponents", "title_fontsize": 9, "alignment": "left"})
    return done.getvalue()


def _scatter(axes: Any, points: Sequence[Point], measure: Measure, colour: str, size: float, marker: str = "o") -> None:
    x, y = [p.seconds for p in points], measure.shown([p.error for p in points])
    faces = [colour if p.complete else "white" for p in points]
    axes.scatter(x, y, s=size, c=faces, edgecolors=colour, marker=marker, linewidths=1, zorder=2)


def _annotate(axes: Any, point: Point, measure: Measure) -> None:
    weight = "bold" if point.is_default else "normal"
    place = point.seconds, measure.shown([point.error])[0]
    style = {"fontsize": 8, "fontweight": weight, "textcoords": "offset points", "xytext": (4, 4)}
    axes.annotate(point.label, place, **style)


def _finish(axes: Any, measure: Measure) -> None:
    axes.set(xlabel="seconds", ylabel=measure.label, yscale="linear" if measure.decibel else "log")
