"""Edges that run one way: along a rail or a post no flow is told, and that of what is around it is found."""

import cv2
import numpy as np
import pytest
from passed_wall import EDGES, T, texture

from stages.motion.depth_sweep import HARDLY_PX
from stages.motion.epipolar import Evidence
from stages.motion.photometric import corroborate
from stages.motion.swept import run_one_way
from stages.shared.artifacts import Dense
from stages.shared.flow_pairs import FlowPairs

SIZE, FAR_PX, MIDDLE = (60, 150), 3, 4
"""Of a wall that a camera passes by FAR_PX a frame, and the frame that is looked at."""


@pytest.mark.parametrize("turned_deg", [0, 30, 90])
def test_stripes_run_one_way(turned_deg: float) -> None:
    rng, (y, x) = np.random.default_rng(3), np.mgrid[:60, :80]
    across = x * np.cos(np.deg2rad(turned_deg)) + y * np.sin(np.deg2rad(turned_deg))
    stripes = 100 + 40 * np.sin(across / 2) + rng.standard_normal(x.shape)
    checks = stripes + 25 * np.sin((y * np.cos(np.deg2rad(turned_deg)) - x * np.sin(np.deg2rad(turned_deg))) / 2)
    assert run_one_way(as_frame(stripes)).mean() > 0.95
    assert run_one_way(as_frame(checks)).mean() < 0.02


def test_what_has_no_edges_runs_no_way() -> None:
    noise = 100 + 3 * np.random.default_rng(4).standard_normal((60, 80))
    assert not run_one_way(as_frame(np.full((60, 80), 100.0))).any()
    assert run_one_way(as_frame(noise)).mean() < 0.05


def as_frame(grey: np.ndarray) -> np.ndarray:
    """As `corroborate` looks at it: a little blurred."""
    return cv2.GaussianBlur(np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2), (0, 0), 0.7)


NEARER_RAIL, BOBS_PX = 4, (0, 1, 0, -1, 0, 1, 1, 0, -1)
"""A rail so much nearer than the wall, which a hand moves up and down by so many px in the frames."""


def of_rail(rail: np.ndarray, scene: float = 1.0, flicker: int = 0) -> float:
    """Evidence of motion on a rail [16, w, 3] before the wall, in its middle; along it its flow is that of the wall."""
    wall, (h, w) = texture(0, (SIZE[0] + 4, SIZE[1] + T * FAR_PX)), SIZE
    rgb = np.empty((T, h, w, 3), np.uint8)
    at = [slice(22 - NEARER_RAIL * bob, 38 - NEARER_RAIL * bob) for bob in BOBS_PX]
    for k, bob in enumerate(BOBS_PX):
        rgb[k] = wall[2 + bob : 2 + bob + h, FAR_PX * k : FAR_PX * k + w]
        rgb[k][at[k]] = np.clip(rail[:, FAR_PX * k : FAR_PX * k + w] + float(flicker * (-1) ** k), 0, 255)
    source, target = EDGES.T
    passed = np.stack([-FAR_PX * (target - source), -np.subtract(*np.take(BOBS_PX, EDGES.T[::-1]))], axis=1)
    flow = np.tile(passed[:, None, None].astype(np.float32), (1, h, w, 1))
    residual = np.zeros((T, h, w), np.float32)
    for e, k in enumerate(source):
        flow[e, at[k], :, 1] *= NEARER_RAIL
        residual[k, at[k]] = 1
    pairs = FlowPairs(
        Dense({"source": source, "target": target, "flow": flow, "confidence": np.ones((len(EDGES), h, w))})
    )
    lines = np.tile(np.eye(3), (len(EDGES), 1, 1)), np.column_stack([passed, np.zeros(len(EDGES))]).astype(float)
    found, _ = corroborate(Evidence(residual, np.ones_like(residual)), rgb, pairs, lines, np.full_like(residual, scene))
    return float(found.residual[MIDDLE, at[MIDDLE], 20:-20][4:-4].mean())


def test_a_rail_whose_flow_is_told_across_alone_is_static() -> None:
    """Along it the flow is that of what is around, with a hand's bob no flow of anything static."""
    rows = texture(6, (16, SIZE[1] + T * FAR_PX))
    assert of_rail(np.repeat(rows[:, :1], rows.shape[1], axis=1)) < 0.1
    assert of_rail(rows) > 0.8  # the same flow, told by its texture, is that of something that moves


def test_flow_along_a_rail_is_believed_before_a_camera_that_hardly_moves() -> None:
    """A scene that it passes by less than a pixel a frame, however the rail moves."""
    rows = texture(6, (16, SIZE[1] + T * FAR_PX))
    rail, passed = np.repeat(rows[:, :1], rows.shape[1], axis=1), HARDLY_PX / np.hypot(FAR_PX, 1)
    assert of_rail(rail, 0.9 * passed) > 0.5
    assert of_rail(rail, 1.1 * passed) < 0.25


def test_a_depth_that_matches_as_badly_as_the_flow_explains_a_rail() -> None:
    """It flickers: without `swept.SHARE_ALONG` .48 of the evidence is left."""
    rows = texture(6, (16, SIZE[1] + T * FAR_PX))
    assert of_rail(np.repeat(rows[:, :1], rows.shape[1], axis=1), flicker=8) < 0.35
