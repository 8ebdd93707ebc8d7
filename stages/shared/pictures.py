"""Pictures drawn by hand with Pillow: matplotlib takes about a second, as long as whole stages."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

FINER = 2
"""Supersampling factor, which smooths lines and letters."""
Places = Callable[[np.ndarray], list[tuple[float, float]]]
"""Data [n, 2] to points of the canvas."""


class Box(NamedTuple):
    """A part of a picture, px."""

    left: float
    top: float
    width: float
    height: float


class Picture:
    """A white picture of a size in px; `pen` draws on it, in units of 1 / FINER px."""

    def __init__(self, width: int, height: int) -> None:
        self.image = Image.new("RGB", (width * FINER, height * FINER), "white")
        self.pen = ImageDraw.Draw(self.image)

    def pixels(self) -> np.ndarray:
        """The picture [height, width, 3] uint8."""
        return np.asarray(self.image.reduce(FINER))

    def write(
        self,
        at: tuple[float, float],
        text: str,
        size: int,
        anchor: str = "mm",
        colour: str = "black",
        bold: bool = False,
    ) -> None:
        """Text of one line or more; the anchor is Pillow's: which point of the text is at this place."""
        font = ImageFont.load_default(size * FINER)
        place = (at[0] * FINER, at[1] * FINER)
        self.pen.text(place, text, colour, font, anchor, 3 * FINER, stroke_width=0.3 * FINER if bold else 0)

    def axes(self, box: Box, limits: tuple[np.ndarray, np.ndarray], title: str) -> Places:
        """A frame with its title above and its limits (low and high [2]) beside."""
        left, top, width, height = box
        low, high = limits
        corners = (left, top, left + width, top + height)
        self.pen.rectangle([FINER * value for value in corners], outline="#888888", width=FINER)
        self.write((left + width / 2, top - 8.5), title, 12)
        for share, anchor in ((0, "lt"), (1, "rt")):
            x, y = low + share * (high - low)
            self.write((left + share * width, top + height + 4), f"{x:.3g}", 11, anchor)
            self.write((left + 4, top + (1 - share) * (height - 14) + 7), f"{y:.3g}", 11, "lm")

        def places(points: np.ndarray) -> list[tuple[float, float]]:
            unit = (points - low) / (high - low)
            return [((left + x * width) * FINER, (top + (1 - y) * height) * FINER) for x, y in unit]

        return places

    def dot(self, place: tuple[float, float], radius: float, colour: str) -> None:
        """A disc about a point of the canvas."""
        (x, y), r = place, radius * FINER
        self.pen.ellipse((x - r, y - r, x + r, y + r), colour)


def square_limits(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Low and high [2] that hold points [n, 2] at one scale of both axes, with some room."""
    middle, reach = (points.min(axis=0) + points.max(axis=0)) / 2, max(float(np.ptp(points, axis=0).max()), 1e-9)
    return middle - 0.55 * reach, middle + 0.55 * reach
