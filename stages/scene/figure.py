"""The report's picture of the decisions: a row per effect with what it saves, beside the threshold."""

import textwrap
from typing import Any

import numpy as np

from stages.shared.pictures import FINER, Picture

WIDTH_PX, ROW_PX = 1200, 64
SCALE_PX = (430, 640)
"""Left and right end of the scale."""
ENDS = (-0.5, 3.0)
"""What is saved at its ends, in thresholds; what lies beyond is drawn at the end."""
NEEDED, SKIPPED = ("#1b7837", "#8dbb9b"), ("#888888", "#c4c4c4")
"""Colours of the estimate and of its interval."""


def decision_table(decisions: dict[str, dict[str, Any]]) -> np.ndarray:
    """One row per effect [h, 1200, 3]: name, verdict, who decided, the statistic with its interval, and the reason.

    The scale is in thresholds: the line is at one.
    """
    picture = Picture(WIDTH_PX, ROW_PX * len(decisions))
    for row, (name, decision) in enumerate(decisions.items()):
        y = (row + 0.5) * ROW_PX
        colours = NEEDED if decision["needed"] else SKIPPED
        _line(picture, (0, WIDTH_PX), (row + 1) * ROW_PX - 0.5, 1, "#dddddd")
        picture.write((20, y), name.replace("_", " "), 18, "lm", bold=True)
        picture.write((205, y), "modelled" if decision["needed"] else "skipped", 18, "lm", colours[0])
        picture.write((305, y), f"by {decision['source']}", 15, "lm", "#555555")
        _line(picture, SCALE_PX, y, 1, "#cccccc")
        if decision["statistic"] is not None:  # what was not tested has none
            low, high = (_place(value / decision["threshold"]) for value in decision["interval"])
            _line(picture, (low, high), y, 7, colours[1])
        _line(picture, (_place(1.0) - 1, _place(1.0) + 1), y, 36, "#b0552b")
        if decision["statistic"] is not None:
            x = _place(decision["statistic"] / decision["threshold"])
            picture.dot((x * FINER, y * FINER), 5, colours[0])
        picture.write((660, y), textwrap.fill(decision["why"], 78), 13, "lm")
    return picture.pixels()


def _place(thresholds: float) -> float:
    """Pixel of a statistic on the scale."""
    return float(np.interp(thresholds, ENDS, SCALE_PX))


def _line(picture: Picture, ends: tuple[float, float], y: float, thick: float, colour: str) -> None:
    """A horizontal line about the height y."""
    corners = (ends[0], y - thick / 2, ends[1], y + thick / 2)
    picture.pen.rectangle([FINER * value for value in corners], colour)
