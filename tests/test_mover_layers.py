"""What the pictures give to movers and to the static scene, where flow is lost."""

import cv2
import numpy as np

from stages.segment.layers import MOVING, StaticWorld, belonging
from stages.segment.superpixels import Superpixels
from stages.shared.artifacts import Dense
from stages.shared.cameras import intrinsics, make_cameras
from stages.shared.flow_pairs import FlowPairs

T, H, W = 5, 96, 256
TILE_PX = 8
GROUND_PX, MOVER_PX = 2, -3
"""Motion to the right from frame to frame."""


def square(k: int) -> np.ndarray:
    """The mover in frame k, [H, W] bool; its flow is known on the left part alone."""
    mover = np.zeros((H, W), bool)
    mover[24:72, 120 + MOVER_PX * k : 184 + MOVER_PX * k] = True
    return mover


def left_part(k: int) -> np.ndarray:
    """The part of the mover that is known to move, [H, W] bool."""
    return square(k) & (np.arange(W) < 160 + MOVER_PX * k)


def clip(contrast: int) -> np.ndarray:
    """Frames [T, H, W, 3] of a textured square before ground that a camera passes; with no contrast both are flat."""
    random = np.random.default_rng(0)
    noise = (random.normal(128, contrast, (H, 2 * W, 3)) for _ in range(2))
    ground, thing = (cv2.GaussianBlur(image, (0, 0), 1.5).clip(0, 255) for image in noise)
    frames = []
    for k in range(T):
        rgb = np.roll(ground, GROUND_PX * k, axis=1)[:, :W]
        frames.append(np.where(square(k)[..., None], np.roll(thing, MOVER_PX * k, axis=1)[:, :W], rgb))
    return np.stack(frames).astype(np.uint8)


def flow_pairs() -> FlowPairs:
    """Flow of the ground everywhere but on the left part of the mover."""
    source, target = np.array([(i, j) for i in range(T) for j in range(T) if 1 <= abs(i - j) <= 2]).T
    flow = np.zeros((len(source), H, W, 2), np.float32)
    for e, (i, j) in enumerate(zip(source, target, strict=True)):
        flow[e, ..., 0] = np.where(left_part(i), MOVER_PX, GROUND_PX) * (j - i)
    columns = {"source": source, "target": target, "flow": flow, "confidence": np.ones(flow.shape[:3], np.float32)}
    return FlowPairs(Dense(columns))


def static_world() -> StaticWorld:
    """Cameras that move to the left before a wall at depth 1: its picture moves by GROUND_PX from frame to frame."""
    poses = np.tile(np.eye(4), (T, 1, 1))
    poses[:, 0, 3] = GROUND_PX / 100 * np.arange(T)
    K = intrinsics(100, 100, W / 2, H / 2)
    cameras = make_cameras(poses, K, np.arange(T))
    return StaticWorld(cameras, cameras.Ks, lambda _: np.ones((H, W), np.float32))


def tiles() -> Superpixels:
    """Squares of 8 px in place of superpixels."""
    v, u = np.mgrid[:H, :W] // TILE_PX
    labels, count = v * (W // TILE_PX) + u, H * W // TILE_PX**2
    first = count * np.arange(T + 1)
    return Superpixels(np.stack(T * [labels]).astype(np.uint16), first, np.full(first[-1], TILE_PX**2), np.zeros(0))


def evidence(contrast: int) -> tuple[Superpixels, np.ndarray]:
    """The tiles of a clip and what its pictures say, where the left part of the mover is known."""
    frames = clip(contrast)
    pixels = tiles()
    sure = pixels.means(np.stack([left_part(k) for k in range(T)]).astype(float)).round()
    return pixels, belonging(pixels, flow_pairs(), lambda k: frames[k], static_world(), sure)


def inner(mask: np.ndarray) -> np.ndarray:
    """A mask [H, W] without 8 px at its border, where tiles are mixed."""
    return cv2.erode(mask.astype(np.uint8), np.ones((17, 17), np.uint8)) > 0


def test_what_moves_with_a_known_part_is_given_to_the_mover() -> None:
    pixels, weight = evidence(contrast=60)
    for k in range(T):
        shown = pixels.paint(weight, k)
        assert np.median(shown[inner(square(k) & ~left_part(k))]) > 0.1 * MOVING


def test_ground_beside_a_mover_is_given_to_the_static_scene() -> None:
    pixels, weight = evidence(contrast=60)
    for k in range(T):
        shown = pixels.paint(weight, k)
        near = np.zeros((H, W), bool)
        near[24:72, 92 + MOVER_PX * k : 120 + MOVER_PX * k] = True
        assert np.median(shown[inner(near)]) < 0
        assert (shown[inner(~square(k))] <= 0).all()
        assert (shown[:, :20] == 0).all(), "far from the mover its motion says nothing"


def test_without_texture_nothing_is_given_to_either() -> None:
    _, weight = evidence(contrast=0)
    assert (weight == 0).all()


def test_where_nothing_is_known_to_move_there_is_no_evidence() -> None:
    frames = clip(60)
    pixels = tiles()
    weight = belonging(pixels, flow_pairs(), lambda k: frames[k], static_world(), np.full(len(pixels.areas), 0.4))
    assert (weight == 0).all()
