"""Static clips whose flow is wrong in ways that add up along a track: nothing of them is called moving."""

import numpy as np
import pytest
from slow_mover import FOUND, STEP, H, T, W, evidence, frames, observed, where

MOST = 1e-3
"""Share of the pixels that may be called moving."""


@pytest.mark.parametrize("noise_px", [0.05, 0.1, 0.2, 0.4])
@pytest.mark.parametrize("grey_levels", [0.0, 6.0])
def test_noise_that_adds_up_is_no_drift(noise_px: float, grey_levels: float) -> None:
    """Over 24 frames a track goes astray by up to 2 px."""
    rgb = frames(STEP, None) + np.random.default_rng(4).normal(0, grey_levels, (T, H, W, 1))
    found = evidence(observed(STEP, STEP, noise_px), np.clip(rgb, 0, 255).astype(np.uint8))
    assert (found > FOUND).mean() < MOST


@pytest.mark.parametrize(("nearest", "moves"), [(2.0, False), (1.0, True)])
def test_flow_between_two_depths_is_no_motion(nearest: float, moves: bool) -> None:
    """Flow that leaks from one depth to the next is that of a depth in between, steadily, and textures may seem to."""
    between = 1.5 * STEP
    moving = np.stack([where(k) for k in range(T)])
    posts = np.arange(W) // 10 % 2 == 0
    inverse_depth = np.broadcast_to(np.where(posts, nearest, 1.0), (T, H, W)).astype(np.float32)
    found = evidence(observed(STEP, between), frames(STEP, between), inverse_depth) > FOUND
    assert (found[moving].mean() > 0.5) == moves
    assert (found.mean() < MOST) != moves
