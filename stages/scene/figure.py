"""The report's picture of the decisions: a row per effect with what it saves, beside the threshold.

Drawn by hand: matplotlib takes as long as a fifth of all the evidence.
"""

import textwrap
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

WIDTH_PX, ROW_PX = 1200, 64
SCALE_PX = (430, 640)
"""Left and right end of the scale."""
ENDS = (-0.5, 3.0)
"""What is saved at its ends, in thresholds; what lies beyond is drawn at the end."""
FINER = 2
"""Supersampling factor, which smooths lines and letters."""
NEEDED, SKIPPED = ("#1b7837", "#8dbb9b"), ("#888888", "#c4c4c4")
"""Colours of the estimate and of its interval."""


def decision_table(decisions: dict[str, dict[str, Any]]) -> np.ndarray:
    """One row per effect [h, 1200, 3]: name, verdict, who decided, the statistic with its interval, and the reason.

    The scale is in thresholds: the line is at one.
    """
    image = Image.new("RGB", (WIDTH_PX * FINER, ROW_PX * len(decisions) * FINER), "white")
    pen = ImageDraw.Draw(image)
    for row, (name, decision) in enumerate(decisions.items()):
        y = (row + 0.5) * ROW_PX
        colours = NEEDED if decision["needed"] else SKIPPED
        _line(pen, (0, WIDTH_PX), (row + 1) * ROW_PX - 0.5, 1, "#dddddd")
        _write(pen, (20, y), name.replace("_", " "), 18, bold=True)
        _write(pen, (205, y), "modelled" if decision["needed"] else "skipped", 18, colours[0])
        _write(pen, (305, y), f"by {decision['source']}", 15, "#555555")
        _line(pen, SCALE_PX, y, 1, "#cccccc")
        if decision["statistic"] is not None:  # what was not tested has none
            low, high = (_place(value / decision["threshold"]) for value in decision["interval"])
            _line(pen, (low, high), y, 7, colours[1])
        _line(pen, (_place(1.0) - 1, _place(1.0) + 1), y, 36, "#b0552b")
        if decision["statistic"] is not None:
            x = _place(decision["statistic"] / decision["threshold"])
            pen.ellipse([FINER * value for value in (x - 5, y - 5, x + 5, y + 5)], colours[0])
        _write(pen, (660, y), textwrap.fill(decision["why"], 78), 13)
    return np.asarray(image.reduce(FINER))


def _place(thresholds: float) -> float:
    """Pixel of a statistic on the scale."""
    return float(np.interp(thresholds, ENDS, SCALE_PX))


def _line(pen: ImageDraw.ImageDraw, ends: tuple[float, float], y: float, thick: float, colour: str) -> None:
    """A horizontal line about the height y."""
    corners = (ends[0], y - thick / 2, ends[1], y + thick / 2)
    pen.rectangle([FINER * value for value in corners], colour)


def _write(
    pen: ImageDraw.ImageDraw,
    at: tuple[float, float],
    text: str,
    size: int,
    colour: str = "black",
    bold: bool = False,
) -> None:
    """Text, of one line or more, that begins at this place and is centred about its height."""
    font = ImageFont.load_default(size * FINER)
    pen.text((at[0] * FINER, at[1] * FINER), text, colour, font, "lm", 6, stroke_width=0.6 if bold else 0)
