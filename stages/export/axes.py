"""Draw the axes of cameras and the pixels of images in the conventions of docs/conventions.md."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np

from stages.shared import cli
from stages.shared.cli import Out
from stages.shared.conventions import CENTRE_PX, FLIP

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CAMERAS = {
    "motionsplat, COLMAP, OpenCV,\nROS optical frame": np.eye(3),
    "OpenGL, Blender,\nnerfstudio": FLIP[:3, :3],
    "ROS body frame\n(REP 103)": np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),
}
"""Axes x, y, z of a camera, as columns in OpenCV axes."""
CENTRES = {"motionsplat, OpenCV, ROS": 0.0, "COLMAP, nerfstudio, gsplat": CENTRE_PX}
"""Coordinate of the centre of the first pixel, both ways."""
VIEW = np.array([[0.85, 0.0, 0.5], [-0.28, -1.0, 0.5]])
"""Where right, down and forward point in the picture (x right, y up), seen from above and behind."""
COLOURS = ("#d62728", "#2ca02c", "#1f77b4")


def main(output: Annotated[Path, Out("picture, e.g. docs/conventions.png")]) -> None:
    """Draw a camera that looks forward with its axes in each convention, and the pixels of a small image in each."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    from stages.shared.atomic import atomic

    figure = Figure(figsize=(10.4, 2.5), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    places = figure.subplots(1, len(CAMERAS) + len(CENTRES))
    for axes, (name, columns) in zip(places, CAMERAS.items(), strict=False):
        _draw_camera(axes, name, columns)
    for axes, (name, centre) in zip(places[len(CAMERAS) :], CENTRES.items(), strict=True):
        _draw_pixels(axes, name, centre)
    figure.canvas.draw()
    image = Image.frombuffer("RGBA", canvas.get_width_height(), canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    with atomic(output) as partial:
        image.convert("RGB").quantize(64, dither=Image.Dither.NONE).save(partial, "PNG", optimize=True)


def _draw_camera(axes: "Axes", name: str, columns: np.ndarray) -> None:
    """A camera that looks forward, with the axes `columns` [3, 3] at its centre."""
    corners = np.array([[-0.55, -0.4, 0.8], [0.55, -0.4, 0.8], [0.55, 0.4, 0.8], [-0.55, 0.4, 0.8]]) @ VIEW.T
    axes.plot(*np.concatenate([corners, corners[:1]]).T, color="#999999", lw=1)
    for corner in corners:
        axes.plot([0, corner[0]], [0, corner[1]], color="#999999", lw=1)
    for letter, axis, colour in zip("xyz", columns.T @ VIEW.T, COLOURS, strict=True):
        axes.annotate("", axis, (0, 0), arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 2, "shrinkA": 0})
        axes.text(
            1.17 * axis[0], 1.17 * axis[1], letter, color=colour, weight="bold", ha="center", va="center", fontsize=11
        )
    _finish(axes, name, (-1.3, 1.5), (-1.3, 1.3))


def _draw_pixels(axes: "Axes", name: str, centre: float) -> None:
    """An image of 3 x 2 pixels with the coordinates of the first centre, of the last and of the upper left corner."""
    for column in range(4):
        axes.plot([column, column], [0, -2], color="#999999", lw=1)
    for row in range(3):
        axes.plot([0, 3], [-row, -row], color="#999999", lw=1)
    for x, y in ((0.5, 0.5), (2.5, 1.5)):
        axes.plot(x, -y, "o", color=COLOURS[0], ms=4)
        axes.text(x, -y - 0.14, f"{x - 0.5 + centre:g}, {y - 0.5 + centre:g}", ha="center", va="top", fontsize=8)
    axes.plot(0, 0, "s", color=COLOURS[2], ms=4)
    corner = centre - 0.5
    axes.text(0, 0.12, f"{corner:g}, {corner:g}", color=COLOURS[2], ha="center", va="bottom", fontsize=8)
    axes.plot(1.5, -1, "+", color=COLOURS[1], ms=9, mew=2)
    middle = "W/2, H/2" if centre else "(W-1)/2, (H-1)/2"
    axes.text(1.5, -2.15, f"middle: {middle}", color=COLOURS[1], ha="center", va="top", fontsize=8)
    _finish(axes, f"pixels:\n{name}", (-0.5, 3.3), (-2.6, 0.6))


def _finish(axes: "Axes", name: str, x: tuple[float, float], y: tuple[float, float]) -> None:
    axes.set(xlim=x, ylim=y, aspect="equal")
    axes.set_title(name, fontsize=9)
    axes.axis("off")


if __name__ == "__main__":
    cli.run(main)
