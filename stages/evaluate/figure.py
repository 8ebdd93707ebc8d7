"""The picture of the scores: the paths of all methods from above and from the side."""

from collections.abc import Mapping

import numpy as np

from stages.shared.charts import colour_of
from stages.shared.pictures import FINER, Box, Picture, square_limits

PLOT_PX, MARGIN_PX, LINE_PX = 420, 34, 20
VIEWS = {"from above (z over x)": ([0, 2], (1, 1)), "from the side (-y over z)": ([2, 1], (1, -1))}
"""The coordinates of a view, across and up, and their signs."""


def draw_paths(paths: Mapping[str, np.ndarray]) -> np.ndarray:
    """Camera centres [k, 3] by method, as pixels [h, w, 3]; the first frame of each is marked. A legend stands below.

    The axes are in the units of the truth, or of ours without truth.
    """
    bottom = MARGIN_PX + PLOT_PX + MARGIN_PX
    picture = Picture(2 * (PLOT_PX + MARGIN_PX) + MARGIN_PX, bottom + LINE_PX * max(len(paths), 1))
    everywhere = np.concatenate([*paths.values(), np.zeros((0 if paths else 1, 3))])
    for column, (title, (axes, signs)) in enumerate(VIEWS.items()):
        box = Box(MARGIN_PX + column * (PLOT_PX + MARGIN_PX), MARGIN_PX, PLOT_PX, PLOT_PX)
        places = picture.axes(box, square_limits(everywhere[:, axes] * signs), title)
        for method, path in sorted(paths.items(), key=lambda drawn: -_style(drawn[0], list(paths))[1]):
            colour, thick = _style(method, list(paths))
            at = places(path[:, axes] * signs)
            picture.pen.line(at, colour, thick)
            picture.dot(at[0], 4, colour)
    for row, method in enumerate(paths):
        colour, thick = _style(method, list(paths))
        y = bottom + (row + 0.5) * LINE_PX - MARGIN_PX / 4
        picture.pen.line([(FINER * x, FINER * y) for x in (MARGIN_PX, MARGIN_PX + 30)], colour, thick)
        picture.write((MARGIN_PX + 40, y), method, 13, "lm")
    return picture.pixels()


def _style(method: str, methods: list[str]) -> tuple[str, int]:
    """Colour and width of a method's line: the broader lie below, so that all of those that agree show."""
    if method == "truth":
        return "#c8c8c8", 10
    return colour_of(method, methods), 3 if method == "ours" else 6
