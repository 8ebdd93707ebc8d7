"""The pinhole image within a distorted one: the largest rectangle about the centre that the lens shows completely."""

from dataclasses import dataclass

import numpy as np

from stages.shared.cameras import pixel_grid
from stages.shared.lens import distort, undistort
from stages.shared.sequences import Sequence


@dataclass(frozen=True)
class Pinhole:
    """An undistorted image of `width` x `height` px that begins `left` and `top` px inside of the original.

    Both have the same centre and the same focal length. Coefficients [2] are k1 / f^2 and k2 / f^4, f in px.
    """

    coefficients: np.ndarray
    original: tuple[int, int]
    left: int = 0
    top: int = 0

    @property
    def width(self) -> int:
        """Pixels."""
        return self.original[0] - 2 * self.left

    @property
    def height(self) -> int:
        """Pixels."""
        return self.original[1] - 2 * self.top

    @property
    def corner(self) -> np.ndarray:
        """The first pixel [2] in the original."""
        return np.array([self.left, self.top], float)

    @property
    def _centre(self) -> np.ndarray:
        return (np.array(self.original) - 1) / 2

    def in_original(self, uv: np.ndarray) -> np.ndarray:
        """Where the original shows pixels [..., 2]."""
        return self._centre + distort(uv + self.corner - self._centre, self.coefficients)

    def from_original(self, uv: np.ndarray) -> np.ndarray:
        """The pixels [..., 2] that the original shows at `uv`."""
        return self._centre + undistort(uv - self._centre, self.coefficients) - self.corner

    def sources(self) -> np.ndarray:
        """Where the original shows every pixel, [H, W, 2]."""
        return self.in_original(pixel_grid(self.height, self.width))


def largest_pinhole(coefficients: np.ndarray, frames: Sequence) -> Pinhole:
    """The largest image of the proportions of the frames with no pixel that they do not show, at most of their size."""
    size = frames.width, frames.height
    for left in range(frames.width // 2):
        found = Pinhole(coefficients, size, left, round(left * frames.height / frames.width))
        edge = np.linspace(0, 1, 101)
        u, v = edge * (found.width - 1), edge * (found.height - 1)
        border = np.concatenate([np.column_stack([u, 0 * u]), np.column_stack([0 * v, v])])
        shown = found.in_original(border)
        if shown.min() >= -0.5:
            return found
    raise AssertionError("the centre is always shown")


def reduced(pinhole: Pinhole, scale: float) -> tuple[int, int]:
    """Size (w, h) of the flow grid of the image, whose pixels are about those of a grid of this scale."""
    w = max(1, round(pinhole.width * scale))
    return w, max(1, pinhole.height * w // pinhole.width)
