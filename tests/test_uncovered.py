"""The ground between two legs, which pictures of neighbouring frames do not show, and what is found of the walker."""

import cv2
import numpy as np
import pytest

from stages.segment import layers, uncovered
from stages.segment.layers import MOVING, belonging
from stages.segment.static_world import StaticWorld
from stages.segment.superpixels import Superpixels
from stages.segment.uncovered import LEAST_FRAMES, Around, frames_around, seen_again
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
    wall = np.ones((H, W), np.float32)
    return StaticWorld(cameras, cameras.Ks, lambda _: wall, lambda _: (wall, np.zeros((H, W), bool)))


LIMIT = np.full((H, W), 256, np.float32)
"""More than any difference."""


def inner(mask: np.ndarray) -> np.ndarray:
    """A mask [H, W] without 2 px at its sides, where compared windows are mixed."""
    return cv2.erode(mask.astype(np.uint8), np.ones((1, 5), np.uint8)) > 0


def around(
    depths: list[np.ndarray], frames: dict[int, np.ndarray], covered: dict[int, np.ndarray], seen: StaticWorld
) -> Around:
    """The frames around the middle one."""
    found = frames_around(MIDDLE, depths[0], frames, covered, seen)
    assert found is not None
    return found


def again(steps_px: int, covered: dict[int, np.ndarray]) -> np.ndarray:
    """`seen_again` of all pixels of the middle frame, at the depth of the ground."""
    depths = [np.ones((H, W), np.float32)]
    return seen_again(LIMIT, depths, around(depths, clip(steps_px), covered, world()))


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
    """All frames but one, and all but two, are covered."""
    near = [MIDDLE - 1, MIDDLE + 1]
    for shown in (near[: LEAST_FRAMES - 1], near):
        covered = {k: np.full((H, W), k not in shown) for k in range(T)}
        known = np.isfinite(again(5, covered))
        assert known[:, 4:-4].all() == (len(shown) >= LEAST_FRAMES)
        assert known.any() == (len(shown) >= LEAST_FRAMES)


def test_from_the_limit_on_nothing_is_said_and_below_it_nothing_changes() -> None:
    covered, depths = {k: between(k, 5) for k in range(T)}, [np.full((H, W), depth) for depth in (1.0, 0.5)]
    given = depths, around(depths, clip(5), covered, world())
    whole = seen_again(LIMIT, *given)
    limit = np.tile(np.float32([0, 1, 5, 20]), (H, W // 4))
    found = seen_again(limit, *given)
    np.testing.assert_array_equal(found, np.where(whole < limit, whole, np.inf))
    assert 0.1 < np.isfinite(found).mean() < 0.9


def turning(random: np.random.Generator) -> tuple[StaticWorld, dict[int, np.ndarray], dict[int, np.ndarray]]:
    """A camera that turns as well, frames of noise, and what covers a fifth of each at random."""
    seen, turns = world(), [np.deg2rad(0.4) * (k - MIDDLE) for k in range(T)]
    seen.cameras.cam_from_world[:, :3, :3] = [cv2.Rodrigues(np.array([0, a, a / 2]))[0] for a in turns]
    frames = {k: random.integers(0, 256, (H, W, 3), np.uint8) for k in range(T)}
    return seen, frames, {k: random.random((H, W)) < 0.2 for k in range(T)}


def test_the_kernel_is_the_quantile_over_uncovered_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pixel by pixel in numpy, for a camera that turns and moves on."""
    monkeypatch.setattr(uncovered, "exposed", lambda frame, _: frame)
    random = np.random.default_rng(3)
    seen, frames, covered = turning(random)
    depths = [random.uniform(0.2, 1.2, (H, W)).astype(np.float32) for _ in range(2)]
    found = seen_again(LIMIT, depths, around(depths, frames, covered, seen))
    for v, u in random.integers((12, 60), (H - 12, W - 60), (60, 2)):
        apart = [_by_numpy(v, u, depth[v, u], frames, covered, seen) for depth in depths]
        best = [np.sort(of)[round(0.3 * (len(of) - 1))] for of in apart if len(of) >= 2]
        np.testing.assert_allclose(found[v, u], min(best, default=np.inf), rtol=1e-3)


def _by_numpy(
    v: int, u: int, depth: float, frames: dict[int, np.ndarray], covered: dict[int, np.ndarray], seen: StaticWorld
) -> list[float]:
    """Differences of windows of 3 px to the frames in which a pixel is in view and not covered."""
    found = []
    for j in (MIDDLE + o for distance in uncovered.DISTANCES for o in (-distance, distance)):
        if j not in frames:
            continue
        A, b = seen.projection(MIDDLE, j)
        x, y, z = A @ [u, v, 1] + depth * b
        x, y = x / z, y / z
        left, top = int(np.floor(x)), int(np.floor(y))
        assert 1 <= left < W - 2, "in view"
        assert 1 <= top < H - 2, "in view"
        if covered[j][top : top + 2, left : left + 2].any():
            continue
        part = frames[j][top - 1 : top + 3, left - 1 : left + 3].astype(float)
        rows = part[:-1] * (1 - (y - top)) + part[1:] * (y - top)
        window = rows[:, :-1] * (1 - (x - left)) + rows[:, 1:] * (x - left)
        found.append(np.abs(window - frames[MIDDLE][v - 1 : v + 2, u - 1 : u + 2]).mean())
    return found


def test_the_best_of_the_static_depths_counts() -> None:
    """Beside what moves depths are wrong; those around are tried as well, each in all frames."""
    covered = {k: between(k, 9) for k in range(T)}
    gap = inner(between(MIDDLE, 9) & ~legs(MIDDLE, 9))
    depths = [np.where(between(MIDDLE, 9), depth, 1).astype(np.float32) for depth in (1.5, 0.6, 1.0)]
    for count, (low, high) in ((2, (APART, 255)), (3, (0, ALIKE))):
        found = seen_again(LIMIT, depths[:count], around(depths, clip(9), covered, world()))
        assert low < np.median(found[gap]) < high


def test_frames_whose_cameras_are_not_known_are_left_out() -> None:
    """All poses but those of two neighbours and of the frame itself are wrong, and marked as not observed."""
    seen, near = world(), [MIDDLE - 2, MIDDLE, MIDDLE + 2]
    wrong = np.isin(np.arange(T), near, invert=True)
    seen.cameras.cam_from_world[wrong, 0, 3] += 0.5
    covered, depths = {k: between(k, 9) for k in range(T)}, [np.ones((H, W), np.float32)]
    free = np.logical_and.reduce([cv2.dilate(between(k, 9).astype(np.uint8), np.ones((1, 15))) == 0 for k in near])
    free[:, :24] = free[:, -24:] = False
    assert np.median(seen_again(LIMIT, depths, around(depths, clip(9), covered, seen))[free]) > APART
    seen.cameras.status[wrong] = "unobserved"
    assert np.percentile(seen_again(LIMIT, depths, around(depths, clip(9), covered, seen))[free], 95) < ALIKE


def evidence(
    frames: dict[int, np.ndarray],
    steps_px: int,
    confidence: float,
    masked: list[np.ndarray],
    scene: np.ndarray | None = None,
) -> np.ndarray:
    """What `belonging` says of the pixels [8, H, W] of the middle frame, by superpixels, in units of MOVING, one by
    one, and in parts; its flow is dragged along with the legs."""
    v, u = np.mgrid[:H, :W] // TILE_PX
    labels, count = v * (W // TILE_PX) + u, H * W // TILE_PX**2
    first = count * np.arange(T + 1)
    pixels = Superpixels(np.stack(T * [labels]).astype(np.uint16), first, np.full(first[-1], TILE_PX**2), np.zeros(0))
    source, target = np.array([(i, j) for i in range(T) for j in range(T) if 1 <= abs(i - j) <= 2]).T
    flow = np.zeros((len(source), H, W, 2), np.float32)
    for e, (i, j) in enumerate(zip(source, target, strict=True)):
        flow[e, ..., 0] = np.where(between(i, steps_px), -steps_px, GROUND_PX) * (j - i)
    sure = np.full(flow.shape[:3], confidence, np.float32)
    pairs = FlowPairs(Dense({"source": source, "target": target, "flow": flow, "confidence": sure}), scene=scene)
    found = belonging(pixels, pairs, frames.__getitem__, world(), pixels.means(np.stack(masked).astype(float)).round())
    return np.stack([pixels.paint(found.weight, MIDDLE) / MOVING, found.of_frame(MIDDLE), *found.in_parts(MIDDLE)])


def test_ground_between_legs_is_taken_from_the_walker(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also as a superpixel that is known to move; where the flow is sure it is not asked for."""
    masked = [between(k, 5) for k in range(T)]
    gap, walker = (inner(of) for of in (between(MIDDLE, 5) & ~legs(MIDDLE, 5), legs(MIDDLE, 5)))
    by_tile, by_pixel, *_ = evidence(clip(5), 5, 0.0, masked)
    assert np.median(by_tile[gap]) < -0.2
    assert np.median(by_pixel[gap]) < -0.5
    assert (by_tile[walker] >= 0).all()
    assert (by_pixel[walker] > -0.1).mean() > 0.98
    assert np.median(evidence(clip(5), 5, 1.0, masked)[0][gap]) >= 0
    monkeypatch.setattr(layers, "seen_again", lambda limit, *_: np.full(limit.shape, np.inf))
    by_tile, by_pixel, *_ = evidence(clip(5), 5, 0.0, masked)
    assert np.median(by_tile[gap]) >= 0
    assert np.median(by_pixel[gap]) > -0.5


def test_a_mover_that_rests_is_not_taken_from_itself() -> None:
    """Found in one frame alone, it looks the same in all others, but its own motion tells no less."""
    frames = clip(-GROUND_PX)  # moves as the ground does: it rests
    masked = [between(k, -GROUND_PX) & (k == MIDDLE) for k in range(T)]
    by_tile, by_pixel, *_ = evidence(frames, -GROUND_PX, 0.0, masked)
    inside = inner(between(MIDDLE, -GROUND_PX))
    assert (by_tile[inside] >= 0).all()
    assert (by_pixel[inside] > -0.1).all()


def test_ground_that_flickers_is_taken_from_nobody() -> None:
    """One difference may be the smaller by chance: it must be small as well."""
    frames, gap = clip(5), inner(between(MIDDLE, 5) & ~legs(MIDDLE, 5))
    random = np.random.default_rng(1)
    for k, frame in frames.items():
        flickers = between(k, 5) & ~legs(k, 5)
        frame[flickers] = random.integers(0, 256, (int(flickers.sum()), 3))
    by_tile, *_ = evidence(frames, 5, 0.0, [between(k, 5) for k in range(T)])
    assert (by_tile[gap] > -0.02).all()


def asked_of(monkeypatch: pytest.MonkeyPatch) -> tuple[dict[int, np.ndarray], dict[int, dict[int, np.ndarray]]]:
    """Limits [H, W] up to which the pixels of each frame are compared, and what covers the frames around it.

    Both are filled while `evidence` asks, on several threads.
    """
    numbers: dict[int, tuple[int, Around]] = {}
    limits: dict[int, np.ndarray] = {}
    coverings: dict[int, dict[int, np.ndarray]] = {}

    def looked_at(i: int, depth: np.ndarray, frames: dict, covered: dict, seen: StaticWorld) -> Around:
        found = frames_around(i, depth, frames, covered, seen)
        assert found is not None
        numbers[id(found)], coverings[i] = (i, found), covered
        return found

    def compared(limit: np.ndarray, _: list[np.ndarray], of: Around) -> np.ndarray:
        limits[numbers[id(of)][0]] = limit
        return np.full(limit.shape, np.inf)

    monkeypatch.setattr(layers, "frames_around", looked_at)
    monkeypatch.setattr(layers, "seen_again", compared)
    return limits, coverings


def test_masks_and_a_little_around_them_are_compared_and_logos_cover(monkeypatch: pytest.MonkeyPatch) -> None:
    limits, coverings = asked_of(monkeypatch)
    logo = np.zeros((H, W), bool)
    logo[10:20, 300:340] = True
    evidence(clip(5), 5, 0.0, [between(k, 5) for k in range(T)], scene=~logo)
    limit, covered = limits[MIDDLE], coverings[MIDDLE]
    shares = between(MIDDLE, 5).reshape(H // TILE_PX, TILE_PX, W // TILE_PX, TILE_PX).mean(axis=(1, 3))
    tiles = np.kron(shares.round(), np.ones((TILE_PX, TILE_PX)))
    near, far = (cv2.dilate(tiles, np.ones((1, 2 * px + 1))) > 0 for px in (4, 5))
    assert (limit[near] > 0).all()
    assert (limit[~far] == 0).all()
    assert set(covered) == set(range(T))
    assert all(of[logo].all() for of in covered.values())
    assert not covered[MIDDLE][~far & ~logo].any()


@pytest.mark.parametrize("share", [0.6, 0.8])
def test_where_most_of_a_frame_moves_nothing_is_seen_again(share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cameras may follow the mover then, and what moves with it would be called static."""
    limits, _ = asked_of(monkeypatch)
    masked = np.arange(W) < share * W
    evidence(clip(5), 5, 0.0, T * [np.tile(masked, (H, 1))])
    asked = (limits[MIDDLE] > 0).mean()
    assert (asked >= share) == (share < 0.7)
    assert (asked == 0) == (share > 0.7)
