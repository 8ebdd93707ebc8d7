"""Shadows that move over ground at rest, which flow follows, and movers, which it follows too."""

import numpy as np
import pytest

from stages.motion import photometric
from stages.motion.epipolar import Evidence
from stages.motion.photometric import SURROUNDINGS
from stages.shared.artifacts import Dense
from stages.shared.flow_pairs import FlowPairs
from stages.shared.planes import surrounding_plane

T, HEIGHT, WIDTH, STEP = 5, 96, 160, 2
PLACE = np.s_[36:60, 68:92]
"""Of what moves, in the middle frame."""
INSIDE = np.s_[40:56, 72:88]


def passing(kind: str, noise: float) -> np.ndarray:
    """Frames [T, h, w, 3] of ground going left, and of a shadow or a mover, also flat or striped, going right."""
    rng = np.random.default_rng(0)
    stripes = np.tile(rng.uniform(60, 220, (24, 4)), 6)
    ground, own = rng.uniform(60, 220, (HEIGHT, 2 * WIDTH)), rng.uniform(60, 220, (24, 24))
    frames = np.stack([ground[:, 40 + STEP * k : 40 + STEP * k + WIDTH] for k in range(T)])
    for k in range(T):
        rows, columns = PLACE
        place = rows, slice(columns.start + STEP * (k - 2), columns.stop + STEP * (k - 2))
        frames[k][place] = {
            "shadow": 0.4 * frames[k][place],
            "mover": own,
            "flat": np.full((24, 24), 90.0),
            "stripes": stripes,
        }[kind]
    frames += rng.normal(0, noise, frames.shape)
    return np.repeat(np.clip(frames.round(), 0, 255).astype(np.uint8)[..., None], 3, axis=-1)


def residual_inside(rgb: np.ndarray) -> float:
    """Mean residual that is left of 1 where flow is sure, follows what moves, and gave it a depth that is wrong."""
    edges = [(i, j) for i in range(T) for j in range(T) if i != j]
    source, target = np.array(edges).T
    flow = np.zeros((len(edges), HEIGHT, WIDTH, 2), np.float32)
    residual, inverse_depth = np.zeros((T, HEIGHT, WIDTH), np.float32), np.ones((T, HEIGHT, WIDTH), np.float32)
    rows, columns = PLACE
    for k in range(T):
        shifted = slice(columns.start + STEP * (k - 2), columns.stop + STEP * (k - 2))
        residual[k, rows, shifted], inverse_depth[k, rows, shifted] = 1, 3
    flow[..., 0] = np.where(residual[source] > 0, 1, -1) * (STEP * (target - source))[:, None, None]
    pairs = FlowPairs(
        Dense({"source": source, "target": target, "flow": flow, "confidence": np.ones(flow.shape[:3], np.float32)})
    )
    projections = np.tile(np.eye(3), (len(edges), 1, 1)), (target - source)[:, None] * [-float(STEP), 0, 0]
    evidence = Evidence(residual, np.ones_like(residual))
    found, _ = photometric.corroborate(evidence, rgb, pairs, projections, inverse_depth)
    return float(found.residual[2][INSIDE].mean())


@pytest.mark.parametrize("noise", [0.0, 4.0])
def test_ground_in_a_moving_shadow_is_at_rest(noise: float) -> None:
    """The pictures match the flow of the shadow's edge better: only the ground's texture says that it rests."""
    assert residual_inside(passing("shadow", noise)) < 0.1


@pytest.mark.parametrize(("kind", "noise"), [("mover", 0.0), ("mover", 4.0), ("flat", 4.0)])
def test_what_hides_the_ground_moves(kind: str, noise: float) -> None:
    """With a texture of its own it is matched along the flow; without one, noise is no texture at rest."""
    assert residual_inside(passing(kind, noise)) > 0.9


def test_a_texture_that_repeats_moves_as_far_as_its_flow_says() -> None:
    """Stripes as wide as the two ways are apart between neighbours are alike along both, which tells nothing."""
    assert residual_inside(passing("stripes", 0.0)) > 0.4


def test_the_plane_around_a_hole_is_that_of_the_ground() -> None:
    """A depth whose weight is zero has no influence."""
    v, u = np.mgrid[:60, :100]
    plane, hole = 0.2 + 0.003 * v + 0.001 * u, np.s_[25:35, 40:60]
    broken, trust = plane.copy(), np.ones_like(plane)
    broken[hole], trust[hole] = 5, 0
    found, known = surrounding_plane(broken, trust, SURROUNDINGS)
    np.testing.assert_allclose(found, plane, rtol=0.02)
    np.testing.assert_allclose(known[30, 50], 1 - 200 / 19**2, atol=0.1, err_msg="mean trust within 19 px")
