"""The picture of the pose stage: trajectory from above and from the side, convergence, depth, residuals.

Drawn by hand: matplotlib takes a second, a quarter of what the stage itself needs.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from stages.ba.state import Step
from stages.shared.drawing import scalar_to_rgb, spread
from stages.shared.images import write_figure

FRAMES = 4
CELL_PX, PLOT_PX, TITLE_PX, MARGIN_PX = 300, 270, 34, 34
SCALE = 2
"""Supersampling factor, which smooths lines and letters."""
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
    size = FRAMES * CELL_PX, bottom + map_px[1] + MARGIN_PX // 2
    image = Image.new("RGB", (size[0] * SCALE, size[1] * SCALE), "white")
    pen = ImageDraw.Draw(image)
    _write(pen, (size[0] / 2, TITLE_PX / 2), title, 15)
    above = "camera from above (z over x), first frame green" + (", loops red" if len(loops) else "")
    _draw_path(pen, 0, centres[:, [0, 2]], above, loops)
    _draw_path(pen, 1, centres[:, [2, 1]] * (1, -1), "camera from the side (-y over z)", loops)
    _draw_convergence(pen, 2, steps)
    _draw_histogram(pen, 3, errors_px)
    for column, k in enumerate(shown):
        left = column * CELL_PX + MARGIN_PX // 2
        coloured = Image.fromarray(scalar_to_rgb(inverse_depth[k], low, high))
        image.paste(coloured.resize((map_px[0] * SCALE, map_px[1] * SCALE)), (left * SCALE, bottom * SCALE))
        label = f"inverse depth, frame {k + 1} of {len(inverse_depth)}"
        _write(pen, (left + map_px[0] / 2, bottom - TITLE_PX / 2), label, 12)
    write_figure(path, np.asarray(image.reduce(SCALE)))


def _draw_path(pen: ImageDraw.ImageDraw, column: int, points: np.ndarray, title: str, loops: np.ndarray) -> None:
    """Points [T, 2] on axes of one scale, the first one marked, and a chord for each of the `loops` [L, 2]."""
    middle, reach = (points.min(axis=0) + points.max(axis=0)) / 2, max(float(np.ptp(points, axis=0).max()), 1e-9)
    at = _draw_axes(pen, column, (middle - 0.55 * reach, middle + 0.55 * reach), title)
    pen.line(at(points), COLOURS[0], SCALE)
    for pair in loops:
        pen.line(at(points[pair]), COLOURS[3], SCALE)
    for k, (x, y) in enumerate(at(points)):
        radius = (2 if k else 4) * SCALE
        pen.ellipse((x - radius, y - radius, x + radius, y + radius), COLOURS[0] if k else COLOURS[2])


def _draw_convergence(pen: ImageDraw.ImageDraw, column: int, steps: Sequence[Step]) -> None:
    """Cost against iteration, one line per phase: the initial guesses, then the refinement."""
    costs = np.log10(np.maximum([step.cost for step in steps], 1e-12)) if steps else np.zeros(1)
    low, high = float(costs.min()), float(costs.max())
    limits = np.array([0, low - 0.05]), np.array([max(len(costs), 2), max(high, low + 1e-3) + 0.05])
    at = _draw_axes(pen, column, limits, "log10 of the robust cost (px^2) per iteration")
    phases = list(dict.fromkeys(step.phase for step in steps))
    for number, phase in enumerate(phases):
        rows = [k for k, step in enumerate(steps) if step.phase == phase]
        pen.line(at(np.stack([rows, costs[rows]], axis=1)), COLOURS[number % len(COLOURS)], 2 * SCALE)


def _draw_histogram(pen: ImageDraw.ImageDraw, column: int, errors_px: np.ndarray) -> None:
    counts, borders = np.histogram(np.minimum(errors_px, CLIPPED_PX), BINS, (0, CLIPPED_PX))
    limits = np.zeros(2), np.array([CLIPPED_PX, 1.05 * max(int(counts.max()), 1)])
    at = _draw_axes(pen, column, limits, "matches by reprojection error, px (3: and more)")
    lower, upper = np.stack([borders[:-1], 0 * counts], axis=1), np.stack([borders[1:], counts], axis=1)
    for (left, base), (right, top) in zip(at(lower), at(upper), strict=True):
        pen.rectangle((left, top, right, base), COLOURS[0])


def _draw_axes(
    pen: ImageDraw.ImageDraw, column: int, limits: tuple[np.ndarray, np.ndarray], title: str
) -> Callable[[np.ndarray], list[tuple[float, float]]]:
    """A frame with its title and limits; returns the map from data [n, 2] to points of the canvas."""
    left, top = column * CELL_PX + MARGIN_PX, 2 * TITLE_PX
    width, height = CELL_PX - MARGIN_PX - 12, PLOT_PX - TITLE_PX - MARGIN_PX // 2
    low, high = limits
    pen.rectangle([v * SCALE for v in (left, top, left + width, top + height)], outline="#888888", width=SCALE)
    _write(pen, (left + width / 2, top - TITLE_PX / 4), title, 12)
    for share, anchor in ((0, "lt"), (1, "rt")):
        x, y = low + share * (high - low)
        _write(pen, (left + share * width, top + height + 4), f"{x:.3g}", 11, anchor)
        _write(pen, (left + 4, top + (1 - share) * (height - 14) + 7), f"{y:.3g}", 11, "lm")

    def at(points: np.ndarray) -> list[tuple[float, float]]:
        unit = (points - low) / (high - low)
        return [((left + x * width) * SCALE, (top + (1 - y) * height) * SCALE) for x, y in unit]

    return at


def _write(pen: ImageDraw.ImageDraw, at: tuple[float, float], text: str, size: int, anchor: str = "mm") -> None:
    font = ImageFont.load_default(size * SCALE)
    pen.text((at[0] * SCALE, at[1] * SCALE), text, "black", font, anchor)
