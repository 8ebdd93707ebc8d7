"""Charts of the report, drawn by matplotlib as SVG or PNG bytes."""

import io
import itertools
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from stages.shared.tables import Row

COLOURS = {"truth": "#1a1a1a", "ours": "#c2410c"}
OTHERS = ("#2563eb", "#0f766e", "#7c3aed", "#a16207", "#be185d", "#475569")
MARKED_POINTS = 20
"""Lines with at most this many points are drawn with markers."""
LEGEND_CHARACTER_IN, LEGEND_MARGIN_IN = 0.068, 0.55
"""Widths in inches of one character in a legend, and of an entry without its text."""
STYLE: Any = {
    "font.family": "sans-serif",
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#888888",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e5e5e5",
    "legend.frameon": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "motionsplat",
    "figure.facecolor": "white",
}


def colour_of(method: str, methods: Sequence[str]) -> str:
    """Colour of a method: fixed for truth and ours, for the others one of six in their order."""
    others = [name for name in methods if name not in COLOURS]
    return COLOURS.get(method) or OTHERS[others.index(method) % len(OTHERS)]


def draw_top(rows: Sequence[Row]) -> bytes:
    """Camera centres from above, as SVG."""
    with figure((5.2, 4.0), "svg") as (fig, done):
        _plot_top(fig.add_subplot(), paths_of(rows))
    return done.getvalue()


def draw_space(rows: Sequence[Row]) -> bytes:
    """Camera centres in 3D, as SVG."""
    with figure((5.2, 4.0), "svg") as (fig, done):
        _plot_space(fig.add_subplot(projection="3d"), paths_of(rows))
    return done.getvalue()


def paths_of(rows: Sequence[Row]) -> dict[str, np.ndarray]:
    """Camera centres [k, 3] by method: truth, ours after the last round, and the best variant of each COLMAP mapper."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        if not row["method"].startswith("ours, "):
            found.setdefault(row["method"], []).append(row)
    best: dict[str, str] = {}
    for method, path in found.items():
        mapper = method.partition(",")[0]
        if mapper not in best or _worth(path) > _worth(found[best[mapper]]):
            best[mapper] = method
    return {method: np.array([[row[axis] for axis in "xyz"] for row in found[method]]) for method in best.values()}


def _worth(path: Sequence[Row]) -> tuple[int, float]:
    """Rank of a path: the number of its frames, then the negative sum of its errors, where known."""
    return len(path), -sum(row["error"] or 0.0 for row in path)


def draw_lines(
    series: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    labels: tuple[str, str],
    methods: Sequence[str],
    log: bool = False,
    zero: bool = False,
) -> bytes:
    """Lines (x, y) by name over a common axis, as SVG.

    Args:
        labels: of the x and the y axis. methods: names that `colour_of` takes its colours from.
        log, zero: whether the y axis is logarithmic, and whether it begins at zero.
    """
    with figure((5.2, 3.1), "svg") as (fig, done):
        axes = fig.add_subplot()
        for name, (x, y) in series.items():
            marker = "o" if len(x) <= MARKED_POINTS else ""
            axes.plot(x, y, label=name, marker=marker, ms=2.5, lw=1.4, color=colour_of(name, methods))
        axes.set(xlabel=labels[0], ylabel=labels[1], yscale="log" if log else "linear")
        if zero:
            axes.set_ylim(bottom=0)
        if len(series) > 1:
            add_legend(axes)
    return done.getvalue()


def draw_runs(values: Sequence[float], runs: Sequence[tuple[str, float]], label: str) -> bytes:
    """One line per uninterrupted run of equal (phase, kernel width) over the iterations, as SVG.

    Costs of different runs are not comparable. Runs that refine the chosen solution are drawn in colour.
    """
    starts = [0, *(k for k in range(1, len(runs)) if runs[k] != runs[k - 1]), len(runs)]
    with figure((5.2, 3.1), "svg") as (fig, done):
        axes = fig.add_subplot()
        for start, end in itertools.pairwise(starts):
            colour = COLOURS["ours"] if runs[start][0].startswith("refinement") else "#a8a29e"
            axes.plot(range(start, end), values[start:end], marker="o", ms=2.5, lw=1.4, color=colour)
        axes.set(xlabel="iteration", ylabel=label, yscale="log")
    return done.getvalue()


def add_legend(axes: Any, title: str = "") -> None:
    """A legend above the figure, with as many columns as fit."""
    handles, names = axes.get_legend_handles_labels()
    fig = axes.get_figure()
    longest = max(map(len, names), default=0)
    fitting = int(fig.get_figwidth() / (LEGEND_CHARACTER_IN * longest + LEGEND_MARGIN_IN))
    style = {"fontsize": 9, "title_fontsize": 9, "alignment": "left", "columnspacing": 1.2}
    fig.legend(handles, names, loc="outside upper left", ncols=max(1, fitting), title=title or None, **style)


@contextmanager
def figure(size: tuple[float, float], kind: str) -> Iterator[tuple[Any, io.BytesIO]]:
    """An empty matplotlib figure of `size` in inches, and the buffer that holds it as `kind` when the block ends."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    done = io.BytesIO()
    with mpl.rc_context(STYLE):
        drawn = Figure(figsize=size, layout="constrained")
        yield drawn, done
        metadata = {"Date": None} if kind == "svg" else {}
        drawn.savefig(done, format=kind, dpi=120, metadata=metadata)


def _plot_top(axes: Any, paths: Mapping[str, np.ndarray]) -> None:
    for method, path in paths.items():
        style = _line_style(method, list(paths))
        axes.plot(path[:, 0], path[:, 2], label=method, **style)
        axes.plot(*path[0, [0, 2]], "o", color=style["color"], ms=4)
    axes.set(xlabel="x, right (scene units)", ylabel="z, forward (scene units)")
    axes.axis("equal")
    if paths:
        add_legend(axes)


def _plot_space(axes: Any, paths: Mapping[str, np.ndarray]) -> None:
    for method, path in paths.items():
        axes.plot(path[:, 0], path[:, 2], -path[:, 1], **_line_style(method, list(paths)))
    _equal_box(axes, np.concatenate(list(paths.values())) if paths else np.zeros((1, 3)))


def _line_style(method: str, methods: Sequence[str]) -> dict[str, Any]:
    if method == "truth":
        return {"color": COLOURS["truth"], "lw": 3, "alpha": 0.35}
    return {"color": colour_of(method, methods), "lw": 1.6, "ls": "-" if method == "ours" else "--"}


def _equal_box(axes: Any, points: np.ndarray) -> None:
    """Set the same scale on all three axes (x, z, -y, so that up is drawn upwards)."""
    turned = points[:, [0, 2, 1]] * [1, 1, -1]
    middle, half = (turned.min(axis=0) + turned.max(axis=0)) / 2, max(np.ptp(turned, axis=0).max() / 2, 1e-9)
    limits = np.stack([middle - half, middle + half], axis=1)
    axes.set(xlim=limits[0], ylim=limits[1], zlim=limits[2], xlabel="x, right", ylabel="z, forward", zlabel="up")
    axes.set_box_aspect((1, 1, 1))
    axes.tick_params(labelsize=7)
