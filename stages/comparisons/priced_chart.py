"""The chart of what the decided effects reach and cost against all of them, beside none of them."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from stages.comparisons.priced import CLOSE_DB, CLOSE_RATIO, TIME_SHARE, Against, Scene, against
from stages.shared.charts import COLOURS, add_legend, figure

GOAL = "#dcd7d2"
STYLES: tuple[dict[str, Any], ...] = (
    {"marker": "o", "s": 30, "zorder": 4, "c": COLOURS["ours"], "edgecolors": COLOURS["ours"], "label": "decided"},
    {"marker": "s", "s": 84, "zorder": 3, "c": "white", "edgecolors": COLOURS["truth"], "label": "none"},
)
"""Told apart by shape and filling as well, for print without colours."""


class _Panel(NamedTuple):
    """A quantity over the scenes: its label, the run with all effects, and the range within which the goal is met."""

    label: str
    of_all: float
    goal: tuple[float, float]


PANELS = (
    _Panel("CPU seconds (share of all effects')", 1.0, (0.0, TIME_SHARE)),
    _Panel("held-out PSNR against all effects (dB)", 0.0, (-CLOSE_DB, math.inf)),
    _Panel("ATE (times that of all effects)", 1.0, (0.0, CLOSE_RATIO)),
)


def draw_priced(scenes: Sequence[Scene], kind: str) -> bytes:
    """Seconds, PSNR and ATE of the decided effects and of none, relative to all of them; one line per scene.

    What the goal allows is shaded. A run without a complete path stands at the edge, crossed.

    Args:
        scenes: at least one. kind: svg or png.
    """
    with figure((9.2, 1.5 + 0.27 * len(scenes)), kind) as (fig, done):
        panels = fig.subplots(1, len(PANELS), sharey=True)
        for axes, panel, column in zip(panels, PANELS, range(len(PANELS)), strict=True):
            values = [
                [_values(against(run, scene.all))[column] for run in (scene.decided, scene.none)] for scene in scenes
            ]
            _draw(axes, panel, values, column)
        panels[0].set_yticks(range(len(scenes)), [scene.sequence for scene in scenes])
        panels[0].set_ylim(len(scenes) - 0.4, -0.6)
        add_legend(panels[0])
    return done.getvalue()


def _values(pair: Against) -> tuple[float | None, float | None, float | None]:
    return pair.time_share, pair.psnr_db, pair.ate_ratio


def _draw(axes: Any, panel: _Panel, values: Sequence[Sequence[float | None]], column: int) -> None:
    """One panel: a line per scene with the values of the decided effects and of none."""
    found = [value for row in values for value in row if value is not None and math.isfinite(value)]
    least, most = min([panel.of_all, *found]), max([panel.of_all, *found])
    if column == 0:
        axes.set_xlim(0, 1.08 * most)
    elif column == 1:
        axes.set_xscale("symlog", linthresh=CLOSE_DB, linscale=0.5)
        axes.set_xlim(min(2 * least, -2 * CLOSE_DB), max(2 * most, 2 * CLOSE_DB))
        _ticks(axes, [sign * size for size in (0.1, 1, 10) for sign in (-1, 1)] + [0])
    else:
        axes.set_xscale("log")
        axes.set_xlim(min(0.8 * least, 0.8), max(1.6 * most, 1.25))
        _ticks(axes, [0.01, 0.1, 0.5, 1, 2, 10, 100, 1000])
    low, high = axes.get_xlim()
    axes.axvspan(max(panel.goal[0], low), min(panel.goal[1], high), color=GOAL, lw=0, zorder=0, label="goal of decided")
    axes.axvline(panel.of_all, color=COLOURS["truth"], lw=1.4, ls="--", label="all effects")
    for style, of_setting in zip(STYLES, zip(*values, strict=True), strict=True):
        places = [math.nan if value is None else min(value, high) for value in of_setting]
        axes.scatter(places, range(len(places)), clip_on=False, **style)
        failed = [k for k, value in enumerate(of_setting) if value == math.inf]
        cross = {"marker": "x", "s": 120, "c": COLOURS["truth"], "clip_on": False, "zorder": 5}
        axes.scatter([high] * len(failed), failed, **cross)
    axes.set_xlabel(panel.label, fontsize=9)


def _ticks(axes: Any, values: Sequence[float]) -> None:
    """Plain numbers at those of the values that lie within the limits."""
    from matplotlib import ticker

    low, high = axes.get_xlim()
    inside = sorted(value for value in values if low <= value <= high)
    axes.set_xticks(inside, [f"{value:g}" for value in inside])
    axes.xaxis.set_minor_locator(ticker.NullLocator())
