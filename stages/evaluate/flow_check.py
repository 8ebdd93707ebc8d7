"""A check without ground truth: residuals of the optical flow on static pixels under poses and depth."""

import numpy as np

from stages.shared.cameras import Posed, grid_from_frame, projection, static_flow

MIN_CONFIDENCE = 0.5
PROTOCOL = (
    "distance between optical flow and the motion that poses and depth predict, on static, confident, triangulated "
    "pixels of all edges; the adjustment minimises it, so it reveals failure, not accuracy"
)


def sample(field: np.ndarray, uv: np.ndarray, scale: float) -> np.ndarray:
    """Values of a field [H', W', ...] on the flow grid at full-frame pixels uv [..., 2], nearest neighbour."""
    grid = np.rint(grid_from_frame(uv, 1 / scale)).astype(int)
    u = np.clip(grid[..., 0], 0, field.shape[1] - 1)
    v = np.clip(grid[..., 1], 0, field.shape[0] - 1)
    return np.asarray(field[v, u])


def flow_residuals(
    uv: np.ndarray,
    inverse_depth: np.ndarray,
    flow_px: np.ndarray,
    source: Posed,
    target: Posed,
) -> np.ndarray:
    """Residuals of one edge in full-frame pixels.

    Args:
        uv: [n, 2] pixels of the source frame.
        inverse_depth: [n] > 0, 1 / z-depth there.
        flow_px: [n, 2] flow to the target frame there, full-frame pixels.
        source, target: cam_from_world [4, 4] and K [3, 3] of the two frames.

    Returns:
        [k] lengths, k <= n: points behind the target camera are left out.
    """
    predicted_px, ratio = static_flow(uv, inverse_depth, *projection(source, target))
    return np.asarray(np.linalg.norm((flow_px - predicted_px)[ratio > 0], axis=-1))
