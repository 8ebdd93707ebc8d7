"""The report's picture of the decisions: a table of effects, verdicts and reasons."""

import textwrap
from typing import Any

import numpy as np

WIDTH_PX, ROW_PX = 1200, 64


def decision_table(decisions: dict[str, dict[str, Any]]) -> np.ndarray:
    """One row per effect [h, 1200, 3]: its name, whether it is modelled, who decided, and the reason with numbers."""
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
        axes.text(210, y, "modelled" if decision["needed"] else "skipped", fontsize=13, va="center", color=colour)
        axes.text(320, y, f"by {decision['source']}", fontsize=11, va="center", color="#555555")
        axes.text(450, y, textwrap.fill(decision["why"], 100), fontsize=10.5, va="center")
    canvas.draw()  # type: ignore[no-untyped-call]
    rgba = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    return np.ascontiguousarray(rgba[..., :3])
