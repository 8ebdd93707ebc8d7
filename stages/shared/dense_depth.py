"""Depth at every pixel of a frame, from the inverse depth that the adjustment writes on a coarser grid."""

import numpy as np

from stages.shared.cameras import frame_from_grid, grid_from_frame
from stages.shared.depth_kernels import upsample
from stages.shared.threads import spread

COLOUR_STD = 0.06
"""Standard deviation of the colour weights (colours in 0..1): depth is not interpolated across larger differences."""
UNLIKE_WEIGHT = 1e-4
"""Added to the colour weights: a pixel whose colour differs from all four grid pixels gets their bilinear mean."""
FARTHEST = 1e3
"""Limit of depth, as a multiple of the median depth: the inverse depth of the sky is 0."""


def dense_depth(inverse_depth: np.ndarray, image: np.ndarray, stride_px: float) -> np.ndarray:
    """Full-size z-depth [H, W] from inverse depth [h, w] on the grid of `ba`, with its edges at those of the frame.

    Joint bilateral upsampling (Kopf et al. 2007) over the four surrounding grid pixels: bilinear weights times colour
    similarity. Inverse depth is interpolated because it is linear in the image across a plane. Fewer pixels are wrong
    than with a guided filter.

    Args:
        image: [H, W, 3] float32 in 0..1.
        stride_px: frame pixels per grid pixel, as in `frame_from_grid`.
    """
    rows, row_weights = _grid_neighbours(image.shape[0], inverse_depth.shape[0], stride_px)
    columns, column_weights = _grid_neighbours(image.shape[1], inverse_depth.shape[1], stride_px)
    centres = (_grid_centres(*sizes, stride_px) for sizes in zip(image.shape[:2], inverse_depth.shape, strict=True))
    grid_image = image[np.ix_(*centres)]
    inverse, like = np.empty(image.shape[:2]), 1 / (2 * COLOUR_STD**2)
    near = (rows, row_weights, columns, column_weights)
    spread(upsample, len(inverse), inverse_depth, grid_image, image, *near, like, UNLIKE_WEIGHT, inverse)
    return (1 / np.maximum(inverse, np.median(inverse) / FARTHEST)).astype(np.float32)


def nearest_on_frame(grid: np.ndarray, stride_px: float, height: int, width: int) -> np.ndarray:
    """Values [F, h, w] on the grid of `ba`, looked up at every pixel of the frames: [F, height, width]."""
    rows, columns = (
        np.minimum(grid_from_frame(np.arange(size), stride_px) + 0.5, grid_size - 1).astype(int)
        for size, grid_size in zip((height, width), grid.shape[1:], strict=True)
    )
    return np.asarray(grid[:, rows][:, :, columns])


def _grid_centres(size: int, grid_size: int, stride_px: float) -> np.ndarray:
    """Index [grid_size] of the pixel in 0..size - 1 nearest to the centre of each grid pixel; at a tie the higher."""
    at = frame_from_grid(np.arange(grid_size), stride_px)
    return np.minimum((at + 0.5).astype(int), size - 1)


def _grid_neighbours(size: int, grid_size: int, stride_px: float) -> tuple[np.ndarray, np.ndarray]:
    """The two grid indices [2, size] around each of `size` pixels, clipped, and their linear weights [2, size]."""
    at = grid_from_frame(np.arange(size), stride_px)
    low = np.floor(at).astype(int)
    return np.stack([low, low + 1]).clip(0, grid_size - 1), np.stack([1 - (at - low), at - low])
