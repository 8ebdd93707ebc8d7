"""The picture of the pose stage: trajectory from above and from the side, convergence, depth, residuals."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stages.ba.dba import Step
from stages.shared.artifacts import atomic
from stages.shared.figures import spread

FRAMES = 4


def draw(
    path: Path, centres: np.ndarray, steps: Sequence[Step], inverse_depth: np.ndarray, errors_px: np.ndarray, title: str
) -> None:
    """Write the picture.

    Args:
        centres: [T, 3] camera centres; inverse_depth: [T, h, w]; errors_px: [n] reprojection errors of static matches.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 5.6), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=11)
    grid = figure.add_gridspec(2, FRAMES, height_ratios=(1.4, 1))
    views = (("from above", 0, 2, "x", "z"), ("from the side", 2, 1, "z", "y"))
    for column, (name, a, b, label_a, label_b) in enumerate(views):
        axes = figure.add_subplot(grid[0, column])
        axes.plot(centres[:, a], centres[:, b], ".-", lw=1)
        axes.plot(centres[0, a], centres[0, b], "go", label="first frame")
        axes.set(title=f"camera path {name}", xlabel=label_a, ylabel=label_b)
        axes.axis("equal")
        axes.legend(fontsize=8)
        if label_b == "y":
            axes.invert_yaxis()
    _draw_convergence(figure.add_subplot(grid[0, 2]), steps)
    axes = figure.add_subplot(grid[0, 3])
    axes.hist(np.clip(errors_px, 0, 3), bins=60)
    axes.set(title="reprojection error", xlabel="px (3 and more in the last bin)", ylabel="matches")
    low, high = np.percentile(inverse_depth, (1, 99))
    for column, k in enumerate(spread(len(inverse_depth), FRAMES)):
        axes = figure.add_subplot(grid[1, column])
        axes.imshow(inverse_depth[k], vmin=low, vmax=high, cmap="viridis")
        axes.set_title(f"inverse depth, frame {k + 1} of {len(inverse_depth)}", fontsize=9)
        axes.axis("off")
    with atomic(path) as partial:
        figure.savefig(partial, format="png")


def _draw_convergence(axes, steps: Sequence[Step]) -> None:  # type: ignore[no-untyped-def]
    """Cost against iteration, one line per phase."""
    position = 0
    phases = list(dict.fromkeys(step.phase for step in steps))
    for phase in phases:
        costs = [step.cost for step in steps if step.phase == phase]
        label = phase if len(phases) < 6 or not phase.startswith("chain") else None
        axes.plot(np.arange(position, position + len(costs)), costs, lw=1, label=label)
        position += len(costs)
    axes.set(title="cost per iteration", xlabel="iteration", ylabel="robust cost, px²")
    if steps:
        axes.set_yscale("log")
        axes.legend(fontsize=7)
