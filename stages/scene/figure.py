"""The report's picture of the decisions: a row per effect with what it saves, beside the threshold."""

import textwrap
from typing import Any

import numpy as np

WIDTH_PX, ROW_PX = 1200, 64
SCALE_PX = (430, 640)
"""Left and right end of the scale."""
ENDS = (-0.5, 3.0)
"""What is saved at its ends, in thresholds; what lies beyond is drawn at the end."""


def decision_table(decisions: dict[str, dict[str, Any]]) -> np.ndarray:
    """One row per effect [h, 1200, 3]: name, verdict, who decided, the statistic with its interval, and the reason.

    The scale is in thresholds: the line is at one.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    height = ROW_PX * len(decisions)
    drawing = Figure(figsize=(WIDTH_PX / 100, height / 100), dpi=100)
    canvas = FigureCanvasAgg(drawing)
    axes = drawing.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, WIDTH_PX), ylim=(height, 0))
    axes.axis("off")
    for row, (name, decision) in enumerate(decisions.items()):
        y = (row + 0.5) * ROW_PX
        colour = "#1b7837" if decision["needed"] else "#888888"
        axes.axhline((row + 1) * ROW_PX, color="#dddddd", linewidth=1)
        axes.text(20, y, name.replace("_", " "), fontsize=13, va="center", weight="bold")
        axes.text(200, y, "modelled" if decision["needed"] else "skipped", fontsize=13, va="center", color=colour)
        axes.text(305, y, f"by {decision['source']}", fontsize=11, va="center", color="#555555")
        axes.plot(SCALE_PX, (y, y), color="#cccccc", linewidth=1)
        axes.plot((_place(1.0),) * 2, (y - 18, y + 18), color="#b0552b", linewidth=1.5)
        if decision["statistic"] is not None:  # what was not tested has none
            low, high = (_place(value / decision["threshold"]) for value in decision["interval"])
            axes.plot((low, high), (y, y), color=colour, linewidth=5, solid_capstyle="butt", alpha=0.5)
            axes.plot(_place(decision["statistic"] / decision["threshold"]), y, "o", color=colour, markersize=7)
        axes.text(660, y, textwrap.fill(decision["why"], 78), fontsize=8.5, va="center")
    canvas.draw()  # type: ignore[no-untyped-call]
    rgba = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    return np.ascontiguousarray(rgba[..., :3])


def _place(thresholds: float) -> float:
    """Pixel of a statistic on the scale."""
    return float(np.interp(thresholds, ENDS, SCALE_PX))
