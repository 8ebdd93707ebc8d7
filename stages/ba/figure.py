"""The picture of the pose stage: trajectory from above and from the side, convergence, depth, residuals."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from stages.ba.state import Step
from stages.shared.drawing import scalar_to_rgb, spread
from stages.shared.images import write_figure
from stages.shared.pictures import FINER, Box, Picture, square_limits

FRAMES = 4
CELL_PX, PLOT_PX, TITLE_PX, MARGIN_PX = 300, 270, 34, 34
COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f")
CLIPPED_PX, BINS = 3.0, 60


def draw(
    path: Path,
    centres: np.ndarray,
    steps: Sequence[Step],
    inverse_depth: np.ndarray,
    errors_px: np.ndarray,
    title: str,
    loops: np.ndarray,
) -> None:
    """Write the picture.

    Args:
        centres: [T, 3] camera centres; inverse_depth: [T, h, w]; errors_px: [n] reprojection errors of static matches.
        loops: [L, 2] frames that are joined at a place seen again.
    """
    low, high = np.percentile(inverse_depth, (1, 99))
    shown = spread(len(inverse_depth), FRAMES)
    h, w = inverse_depth.shape[1:]
    map_px = CELL_PX - MARGIN_PX, round((CELL_PX - MARGIN_PX) * h / w)
    bottom = TITLE_PX + PLOT_PX + TITLE_PX
    picture = Picture(FRAMES * CELL_PX, bottom + map_px[1] + MARGIN_PX // 2)
    picture.write((FRAMES * CELL_PX / 2, TITLE_PX / 2), title, 15)
    above = "camera from above (z over x), first frame green" + (", loops red" if len(loops) else "")
    _draw_path(picture, 0, centres[:, [0, 2]], above, loops)
    _draw_path(picture, 1, centres[:, [2, 1]] * (1, -1), "camera from the side (-y over z)", loops)
    _draw_convergence(picture, 2, steps)
    _draw_histogram(picture, 3, errors_px)
    for column, k in enumerate(shown):
        left = column * CELL_PX + MARGIN_PX // 2
        coloured = Image.fromarray(scalar_to_rgb(inverse_depth[k], low, high))
        picture.image.paste(coloured.resize((map_px[0] * FINER, map_px[1] * FINER)), (left * FINER, bottom * FINER))
        label = f"inverse depth, frame {k + 1} of {len(inverse_depth)}"
        picture.write((left + map_px[0] / 2, bottom - TITLE_PX / 2), label, 12)
    write_figure(path, picture.pixels())


def _draw_path(picture: Picture, column: int, points: np.ndarray, title: str, loops: np.ndarray) -> None:
    """Points [T, 2] on axes of one scale, the first one marked, and a chord for each of the `loops` [L, 2]."""
    at = picture.axes(_box(column), square_limits(points), title)
    picture.pen.line(at(points), COLOURS[0], FINER)
    for pair in loops:
        picture.pen.line(at(points[pair]), COLOURS[3], FINER)
    for k, place in enumerate(at(points)):
        picture.dot(place, 2 if k else 4, COLOURS[0] if k else COLOURS[2])


def _draw_convergence(picture: Picture, column: int, steps: Sequence[Step]) -> None:
    """Cost against iteration, one line per phase: the initial guesses, then the refinement."""
    costs = np.log10(np.maximum([step.cost for step in steps], 1e-12)) if steps else np.zeros(1)
    low, high = float(costs.min()), float(costs.max())
    limits = np.array([0, low - 0.05]), np.array([max(len(costs), 2), max(high, low + 1e-3) + 0.05])
    at = picture.axes(_box(column), limits, "log10 of the robust cost (px^2) per iteration")
    phases = list(dict.fromkeys(step.phase for step in steps))
    for number, phase in enumerate(phases):
        rows = [k for k, step in enumerate(steps) if step.phase == phase]
        picture.pen.line(at(np.stack([rows, costs[rows]], axis=1)), COLOURS[number % len(COLOURS)], 2 * FINER)


def _draw_histogram(picture: Picture, column: int, errors_px: np.ndarray) -> None:
    counts, borders = np.histogram(np.minimum(errors_px, CLIPPED_PX), BINS, (0, CLIPPED_PX))
    limits = np.zeros(2), np.array([CLIPPED_PX, 1.05 * max(int(counts.max()), 1)])
    at = picture.axes(_box(column), limits, "matches by reprojection error, px (3: and more)")
    lower, upper = np.stack([borders[:-1], 0 * counts], axis=1), np.stack([borders[1:], counts], axis=1)
    for (left, base), (right, top) in zip(at(lower), at(upper), strict=True):
        picture.pen.rectangle((left, top, right, base), COLOURS[0])


def _box(column: int) -> Box:
    """Where the axes of a column stand."""
    width, height = CELL_PX - MARGIN_PX - 12, PLOT_PX - TITLE_PX - MARGIN_PX // 2
    return Box(column * CELL_PX + MARGIN_PX, 2 * TITLE_PX, width, height)
