"""The ground between two legs, which pictures of neighbouring frames do not show, and what is found of the walker."""

import cv2
import numpy as np
import pytest

from stages.segment import layers
from stages.segment.layers import MOVING, belonging
from stages.segment.static_world import StaticWorld
from stages.segment.superpixels import Superpixels
from stages.segment.uncovered import LEAST_FRAMES, seen_again
from stages.shared.artifacts import Dense
from stages.shared.cameras import intrinsics, make_cameras
from stages.shared.flow_pairs import FlowPairs

T, H, W, TILE_PX = 15, 96, 384, 4
GROUND_PX, LEG_PX, GAP_PX = 2, 12, 12
"""Motion of the ground from frame to frame; width of a leg, and of the ground between two of them."""
MIDDLE = 7
ALIKE, APART = 4, 9
"""Colour levels: of what is the same, up to the exposure as two pictures tell it; of what is not."""


def legs(k: int, steps_px: int) -> np.ndarray:
    """Two legs in frame k, [H, W] bool, which walk by so many pixels a frame."""
    walker = np.zeros((H, W), bool)
    left = 174 + steps_px * (MIDDLE - k)
    for begin in (left, left + LEG_PX + GAP_PX):
        walker[:, max(begin, 0) : max(begin + LEG_PX, 0)] = True
    return walker


def between(k: int, steps_px: int) -> np.ndarray:
    """The legs and the ground between them, [H, W] bool: what masks call moving."""
    return cv2.morphologyEx(legs(k, steps_px).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((1, 2 * GAP_PX + 1))) > 0


def clip(steps_px: int) -> dict[int, np.ndarray]:
    """Frames [H, W, 3] uint8 of a textured ground that a camera passes, with the legs before it."""
    random = np.random.default_rng(0)
    noise = (random.normal(128, 120, (H, 3 * W, 3)) for _ in range(2))
    ground, cloth = (cv2.GaussianBlur(image, (0, 0), 1.5).clip(0, 255).astype(np.uint8) for image in noise)
    frames = {}
    for k in range(T):
        walker = np.roll(cloth, -steps_px * k, axis=1)[:, :W]
        frames[k] = np.where(legs(k, steps_px)[..., None], walker, np.roll(ground, GROUND_PX * k, axis=1)[:, :W])
    return frames


def world() -> StaticWorld:
    """A camera that moves to the left before a wall at depth 1."""
    poses = np.tile(np.eye(4), (T, 1, 1))
    poses[:, 0, 3] = GROUND_PX / 100 * np.arange(T)
    cameras = make_cameras(poses, intrinsics(100, 100, W / 2, H / 2), np.arange(1, T + 1))
    return StaticWorld(cameras, cameras.Ks, lambda _: np.ones((H, W), np.float32))


def inner(mask: np.ndarray) -> np.ndarray:
    """A mask [H, W] without 2 px at its sides, where compared windows are mixed."""
    return cv2.erode(mask.astype(np.uint8), np.ones((1, 5), np.uint8)) > 0


def again(steps_px: int, covered: dict[int, np.ndarray]) -> np.ndarray:
    """`seen_again` of all pixels of the middle frame, at the depth of the ground."""
    sought, depths = np.ones((H, W), bool), [np.ones((H, W), np.float32)]
    return seen_again(MIDDLE, sought, depths, clip(steps_px), covered, world())


@pytest.mark.parametrize("steps_px", [5, 9])
def test_ground_between_legs_looks_the_same_where_nothing_covers_it(steps_px: int) -> None:
    found = again(steps_px, {k: between(k, steps_px) for k in range(T)})
    walker, whole = legs(MIDDLE, steps_px), between(MIDDLE, steps_px)
    assert np.percentile(found[inner(whole & ~walker)], 95) < ALIKE
    assert np.percentile(found[inner(walker)], 5) > APART


def test_ground_is_found_where_masks_miss_the_walker() -> None:
    """It is seen again in half of the frames; the others count as well, and no mean over them would tell."""
    found = again(2, {k: np.zeros((H, W), bool) for k in range(T)})
    gap = inner(between(MIDDLE, 2) & ~legs(MIDDLE, 2))
    hidden = np.mean([np.roll(legs(k, 2), GROUND_PX * (MIDDLE - k), axis=1)[gap] for k in range(T)])
    assert hidden > 0.35
    assert np.percentile(found[gap], 90) < ALIKE
    assert np.percentile(found[inner(legs(MIDDLE, 2))], 5) > APART


def test_what_too_few_frames_show_is_not_known() -> None:
    """Of frames before and after, all but one, and all but two, are covered; nor is that known which is not sought."""
    near = [MIDDLE - 1, MIDDLE + 1]
    for shown in (near[: LEAST_FRAMES - 1], near):
        covered = {k: np.full((H, W), k not in shown) for k in range(T)}
        known = np.isfinite(again(5, covered))
        assert known[:, 4:-4].all() == (len(shown) >= LEAST_FRAMES)
        assert known.any() == (len(shown) >= LEAST_FRAMES)
    sought = np.zeros((H, W), bool)
    sought[:, 140:160] = True
    depths, covered = [np.ones((H, W), np.float32)], {k: np.zeros((H, W), bool) for k in range(T)}
    known = np.isfinite(seen_again(MIDDLE, sought, depths, clip(5), covered, world()))
    np.testing.assert_array_equal(known, sought)


def test_the_best_of_the_static_depths_counts() -> None:
    """Beside what moves depths are wrong; those around are tried as well, each in all frames."""
    covered = {k: between(k, 9) for k in range(T)}
    gap, sought = inner(between(MIDDLE, 9) & ~legs(MIDDLE, 9)), np.ones((H, W), bool)
    depths = [np.where(between(MIDDLE, 9), depth, 1).astype(np.float32) for depth in (1.5, 0.6, 1.0)]
    for count, (low, high) in ((2, (APART, 255)), (3, (0, ALIKE))):
        found = seen_again(MIDDLE, sought, depths[:count], clip(9), covered, world())
        assert low < np.median(found[gap]) < high


def test_frames_whose_cameras_are_not_known_are_left_out() -> None:
    """All poses but those of two neighbours and of the frame itself are wrong, and marked as not observed."""
    seen, sought = world(), np.ones((H, W), bool)
    near = [MIDDLE - 2, MIDDLE, MIDDLE + 2]
    wrong = np.isin(np.arange(T), near, invert=True)
    seen.cameras.cam_from_world[wrong, 0, 3] += 0.5
    covered, depths = {k: between(k, 9) for k in range(T)}, [np.ones((H, W), np.float32)]
    free = np.logical_and.reduce([cv2.dilate(between(k, 9).astype(np.uint8), np.ones((1, 15))) == 0 for k in near])
    free[:, :24] = free[:, -24:] = False
    assert np.median(seen_again(MIDDLE, sought, depths, clip(9), covered, seen)[free]) > APART
    seen.cameras.status[wrong] = "unobserved"
    assert np.percentile(seen_again(MIDDLE, sought, depths, clip(9), covered, seen)[free], 95) < ALIKE


def evidence(frames: dict[int, np.ndarray], steps_px: int, confidence: float, masked: list[np.ndarray]) -> np.ndarray:
    """What `belonging` says of the pixels [2, H, W] of the middle frame, by superpixels, in units of MOVING, and one by
    one; its flow is dragged along with the legs."""
    v, u = np.mgrid[:H, :W] // TILE_PX
    labels, count = v * (W // TILE_PX) + u, H * W // TILE_PX**2
    first = count * np.arange(T + 1)
    pixels = Superpixels(np.stack(T * [labels]).astype(np.uint16), first, np.full(first[-1], TILE_PX**2), np.zeros(0))
    source, target = np.array([(i, j) for i in range(T) for j in range(T) if 1 <= abs(i - j) <= 2]).T
    flow = np.zeros((len(source), H, W, 2), np.float32)
    for e, (i, j) in enumerate(zip(source, target, strict=True)):
        flow[e, ..., 0] = np.where(between(i, steps_px), -steps_px, GROUND_PX) * (j - i)
    sure = np.full(flow.shape[:3], confidence, np.float32)
    pairs = FlowPairs(Dense({"source": source, "target": target, "flow": flow, "confidence": sure}))
    found = belonging(pixels, pairs, frames.__getitem__, world(), pixels.means(np.stack(masked).astype(float)).round())
    return np.stack([pixels.paint(found.weight, MIDDLE) / MOVING, found.of_frame(MIDDLE)])


def test_ground_between_legs_is_taken_from_the_walker(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also as a superpixel that is known to move; where the flow is sure it is not asked for."""
    masked = [between(k, 5) for k in range(T)]
    gap, walker = (inner(of) for of in (between(MIDDLE, 5) & ~legs(MIDDLE, 5), legs(MIDDLE, 5)))
    by_tile, by_pixel = evidence(clip(5), 5, 0.0, masked)
    assert np.median(by_tile[gap]) < -0.2
    assert np.median(by_pixel[gap]) < -0.5
    assert (by_tile[walker] >= 0).all()
    assert (by_pixel[walker] > -0.1).mean() > 0.98
    assert np.median(evidence(clip(5), 5, 1.0, masked)[0][gap]) >= 0
    monkeypatch.setattr(layers, "seen_again", lambda _, sought, *__: np.full(sought.shape, np.inf))
    by_tile, by_pixel = evidence(clip(5), 5, 0.0, masked)
    assert np.median(by_tile[gap]) >= 0
    assert np.median(by_pixel[gap]) > -0.5


def test_a_mover_that_rests_is_not_taken_from_itself() -> None:
    """Found in one frame alone, it looks the same in all others, but its own motion tells no less."""
    frames = clip(-GROUND_PX)  # moves as the ground does: it rests
    masked = [between(k, -GROUND_PX) & (k == MIDDLE) for k in range(T)]
    by_tile, by_pixel = evidence(frames, -GROUND_PX, 0.0, masked)
    inside = inner(between(MIDDLE, -GROUND_PX))
    assert (by_tile[inside] >= 0).all()
    assert (by_pixel[inside] > -0.1).all()
