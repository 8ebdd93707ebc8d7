"""What hides static surface that seems nearer moves; a hole in it, through which one sees what is far, does not."""

from unittest.mock import Mock

import cv2
import numpy as np
import pytest

from stages.motion import __main__ as motion
from stages.motion import hiding as module
from stages.motion.epipolar import Evidence
from stages.motion.hiding import hiding
from stages.shared.artifacts import Dense
from stages.shared.cameras import Cameras
from stages.shared.flow_pairs import FlowPairs

T, H, W = 24, 72, 128
WALL_PX = 2
"""Motion of the wall per frame; what is far does not move in the image."""
SIDE = slice(28, 48)


def texture(seed: int, size: tuple[int, int]) -> np.ndarray:
    """Grey blotches [h, w] uint8 of some pixels."""
    canvas = cv2.GaussianBlur(np.random.default_rng(seed).normal(0, 1, size), (0, 0), 1.2)
    return np.clip(120 + 35 * canvas / canvas.std(), 0, 255).astype(np.uint8)


WALL, FAR = texture(5, (H, W + T * WALL_PX)), texture(6, (H, W))


def cameras() -> tuple[np.ndarray, np.ndarray]:
    """Cameras that move to the right, before which what is at inverse depth 1 moves by WALL_PX to the left."""
    poses, Ks = np.tile(np.eye(4), (T, 1, 1)), np.tile(np.diag([100.0, 100.0, 1.0]), (T, 1, 1))
    poses[:, 0, 3] = -WALL_PX / 100 * np.arange(T)
    return poses, Ks


def clip(window_px: int, inverse: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frames [T, H, W, 3], inverse depth by the flow, and where [T, H, W] a thing is seen before or in the wall.

    Args:
        window_px: motion to the left of the square in which it is seen, per frame. inverse: its inverse depth.
    """
    frames, thing = np.empty((T, H, W), np.uint8), np.zeros((T, H, W), bool)
    for k in range(T):
        frames[k] = WALL[:, k * WALL_PX : k * WALL_PX + W]
        left = 70 - k * window_px
        thing[k, SIDE, max(left, 0) : max(left + 20, 0)] = True
        frames[k][thing[k]] = np.roll(FAR, -round(k * inverse * WALL_PX), axis=1)[thing[k]]
    return np.repeat(frames[..., None], 3, axis=-1), np.where(thing, inverse, 1.0).astype(np.float32), thing


def found(window_px: int, inverse: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """What hides something, and where the thing is seen."""
    frames, inverse_depth, thing = clip(window_px, inverse)
    certain = Evidence(np.zeros((T, H, W), np.float32), np.ones((T, H, W), np.float32))
    return hiding(frames, cameras(), inverse_depth, certain), thing


def test_what_moves_with_the_camera_is_found_by_what_it_hides() -> None:
    """Its flow is exactly that of something at infinity, so that no residual shows it."""
    hides, moves = found(0)
    inside = np.stack([cv2.erode(of.astype(np.uint8), np.ones((7, 7))) > 0 for of in moves])
    assert hides[inside].mean() > 0.6
    assert not hides[~moves].any()


def test_what_is_seen_through_a_hole_in_the_wall_hides_nothing() -> None:
    """The wall around the hole is nearer, but it is never where the hole is."""
    hides, _ = found(WALL_PX)
    assert not hides.any()


def test_what_is_nearer_than_the_wall_may_hide_it() -> None:
    hides, _ = found(2 * WALL_PX, 2.0)
    assert not hides.any()


@pytest.mark.parametrize("of", ["residual", "weight"])
def test_surface_whose_depth_is_not_sure_is_no_evidence(of: str) -> None:
    frames, inverse_depth, moves = clip(0)
    values = {"residual": np.zeros((T, H, W), np.float32), "weight": np.ones((T, H, W), np.float32)}
    values[of][~moves] = {"residual": 0.5, "weight": 0.0}[of]
    assert not hiding(frames, cameras(), inverse_depth, Evidence(**values)).any()


def test_a_frame_without_evidence_shows_nothing() -> None:
    """Its camera is interpolated: all of the wall would be elsewhere."""
    frames, inverse_depth, _ = clip(0)
    residual, weight = np.zeros((T, H, W), np.float32), np.ones((T, H, W), np.float32)
    weight[12] = 0
    hides = hiding(frames, cameras(), inverse_depth, Evidence(residual, weight))
    assert not hides[12].any()
    assert hides[11].any()


def test_surfaces_are_found_once_per_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clip is worked on block by block, and each block needs frames of those around."""
    frames, inverse_depth, _ = clip(0)
    found = Mock(wraps=module._surface)
    monkeypatch.setattr(module, "_surface", found)
    certain = Evidence(np.zeros((T, H, W), np.float32), np.ones((T, H, W), np.float32))
    hiding(frames, cameras(), inverse_depth, certain)
    assert found.call_count == T


def test_surface_that_is_seen_nowhere_again_is_no_evidence() -> None:
    """Wrong depth of the wall: it is not where it should be in any frame, but by chance."""
    frames, inverse_depth, moves = clip(0)
    certain = Evidence(np.zeros((T, H, W), np.float32), np.ones((T, H, W), np.float32))
    assert hiding(frames, cameras(), 2.5 * inverse_depth, certain)[moves].mean() < 0.05


def test_a_clip_too_short_to_see_a_surface_again_shows_nothing() -> None:
    frames, inverse_depth, _ = (of[:3] for of in clip(0))
    poses, Ks = (of[:3] for of in cameras())
    certain = Evidence(np.zeros((3, H, W), np.float32), np.ones((3, H, W), np.float32))
    assert not hiding(frames, (poses, Ks), inverse_depth, certain).any()


def test_the_prior_finds_what_moves_with_the_camera() -> None:
    """With flow without any error, under the right cameras."""
    frames, inverse_depth, moves = clip(0)
    source, target = np.array([(i, j) for i in range(T) for j in (i - 2, i - 1, i + 1, i + 2) if 0 <= j < T]).T
    flow = np.zeros((len(source), H, W, 2), np.float32)
    flow[..., 0] = -WALL_PX * (target - source)[:, None, None] * ~moves[source]
    confidence = np.full(flow.shape[:3], 0.8, np.float32)
    pairs = FlowPairs(Dense({"source": source, "target": target, "flow": flow, "confidence": confidence}))
    poses, Ks = cameras()
    numbers, none = np.arange(1, T + 1), np.zeros((T, 6, 6))
    seen = Cameras(poses, Ks, numbers, none, np.full(T, "estimated"), np.ones(T, bool))
    depth = {"inverse_depth": inverse_depth.astype(np.float16)}
    evidence, *_ = motion._from_cameras(frames, pairs, seen, depth, 1.0, 1.0, None)
    assert evidence.residual[moves].mean() > 0.3
    assert evidence.residual[~moves].mean() < 0.02
