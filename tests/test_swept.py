"""Static depths that the pictures tell where flow is lost: of a thin pole before a wall that the camera passes."""

import cv2
import numpy as np
import pytest
from passed_wall import EDGES, T, texture

from stages.motion.depth_sweep import (
    HARDLY_PX,
    LITTLE_NEARER,
    NEARER,
    STEPS,
    Other,
    hardly_moves,
    least_difference,
)
from stages.motion.epipolar import Evidence
from stages.motion.photometric import corroborate
from stages.motion.swept import explained
from stages.shared.artifacts import Dense
from stages.shared.flow_pairs import FlowPairs

SIZE, FAR_PX, NEAR_PX = (60, 150), 3, 11
"""Of a wall that a camera passes by FAR_PX a frame, and of a pole before it, which it passes by NEAR_PX."""
MIDDLE = 4
WALL = np.full(SIZE, NEAR_PX / FAR_PX / LITTLE_NEARER + 0.01)
"""Its inverse depth, in units that put the pole within reach of the search."""


def pole(k: int, height: int = 30, rises_px: int = 0, passes_px: int = NEAR_PX) -> tuple[slice, slice]:
    """Rows and columns of the pole in frame k: 4 px wide, `height` px high; it rises and passes so many px a frame."""
    left, top = 73 - passes_px * (k - MIDDLE), 15 - rises_px * (k - MIDDLE)
    return slice(max(top, 0), max(top + height, 0)), slice(left, left + 4)


def clip(noise: float = 0.0, **of_pole: int) -> np.ndarray:
    """Frames [T, h, w, 3] uint8 of the pole before the wall."""
    wall, bark = texture(0, (SIZE[0], SIZE[1] + T * FAR_PX)), texture(1, (30, 4))
    rng, frames = np.random.default_rng(2), []
    for k in range(T):
        frame = wall[:, FAR_PX * k : FAR_PX * k + SIZE[1]].astype(float)
        place = pole(k, **of_pole)
        frame[place] = 0.4 * bark[: frame[place].shape[0]]
        frames.append(frame + noise * rng.standard_normal(frame.shape))
    return np.clip(frames, 0, 255).astype(np.uint8)


def corroborated(rgb: np.ndarray, confidence: float = 0.0, fits_none: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Residual and what passes [T, h, w], where all flow is the wall's, and that of the pole may fit no depth."""
    source, target = EDGES.T
    flow = np.zeros((len(EDGES), *SIZE, 2), np.float32)
    flow[..., 0] = -FAR_PX * (target - source)[:, None, None]
    sure = np.full((len(EDGES), *SIZE), confidence, np.float32)
    pairs = FlowPairs(Dense({"source": source, "target": target, "flow": flow, "confidence": sure}))
    lines = np.tile(np.eye(3), (len(EDGES), 1, 1)), (target - source)[:, None] * [-float(FAR_PX), 0, 0]
    residual = np.zeros((T, *SIZE), np.float32)
    for k in range(T):
        residual[k][pole(k)] = fits_none
    evidence = Evidence(residual, np.ones_like(residual))
    found, passing = corroborate(evidence, rgb, pairs, lines, np.ones_like(residual))
    return found.residual, passing


@pytest.mark.parametrize("noise", [0.0, 6.0])
def test_a_pole_at_a_depth_that_no_flow_tells_is_static(noise: float) -> None:
    residual, _ = corroborated(clip(noise=noise))
    for k in (0, MIDDLE, T - 1):  # the first and the last frame have others on one side alone
        assert residual[k][pole(k)].mean() < 0.1, k


def test_a_pole_that_has_the_flow_of_the_wall_does_not_pass() -> None:
    _, passing = corroborated(clip(), fits_none=False)
    assert (passing[MIDDLE][pole(MIDDLE)] > 0.5).mean() < 0.2  # its ends share windows with the wall


def test_what_rises_across_the_lines_of_sight_still_moves() -> None:
    _, passing = corroborated(clip(height=6, rises_px=8))
    assert (passing[MIDDLE][pole(MIDDLE, height=6)] > 0.5).mean() > 0.5


def test_flow_that_is_sure_is_believed() -> None:
    residual, _ = corroborated(clip(height=0), confidence=1.0)
    assert residual[MIDDLE][pole(MIDDLE)].mean() > 0.9


def others(rgb: np.ndarray, steps: list[int], way_px: float = FAR_PX, by_flow: float = 50.0) -> list[Other]:
    """The frames so many steps from the middle one, and what the flow leaves of the pole; of the wall 2 levels."""
    leaves, inside = np.full(SIZE, 2, np.float32), np.ones(SIZE, bool)
    leaves[pole(MIDDLE)] = by_flow
    lines = [(np.eye(3), np.array([-way_px * step, 0, 0])) for step in steps]
    here = rgb[MIDDLE]
    return [Other(step, rgb[MIDDLE + step], here, leaves, inside, *of) for step, of in zip(steps, lines, strict=True)]


def test_least_difference_is_that_of_a_slow_search() -> None:
    rgb, sought = clip(noise=3), np.zeros(SIZE, bool)
    sought[[0, 20, 30, 59], [0, 74, 20, 149]] = True
    found = least_difference(others(rgb, [-1, 1, -2, 2]), sought, nearest=1e9)
    assert np.isinf(found[~sought]).all()
    for v, u in np.argwhere(sought):
        own = NEAR_PX if 70 < u < 80 else FAR_PX
        if 0 < v < SIZE[0] - 1:  # the few pixels of a corner match by chance elsewhere
            assert found[v, u] <= slowly(rgb, v, u, np.array([own])) + 1e-3
        assert found[v, u] >= slowly(rgb, v, u, np.arange(0, STEPS, 0.125)) - 1e-3


def slowly(rgb: np.ndarray, v: int, u: int, ways_px: np.ndarray) -> float:
    """Least difference over ways from frame to frame, by images that OpenCV shifts."""
    differences = []
    for way in ways_px:
        sides: dict[bool, list[float]] = {False: [], True: []}
        for step in (-1, 1, -2, 2):
            x = u - way * step
            if not 0 <= x <= SIZE[1] - 1:
                continue
            there = cv2.warpAffine(
                rgb[MIDDLE + step].astype(np.float32),
                np.array([[1, 0, -way * step], [0, 1, 0]], float),
                SIZE[::-1],
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderValue=(np.nan,) * 3,
            )
            window = slice(max(v - 2, 0), v + 3), slice(max(u - 2, 0), u + 3)
            apart = np.abs(there[window] - rgb[MIDDLE][window].astype(np.float32)).mean(axis=-1)
            sides[step > 0].append(float(np.nanmean(apart)))
        if sides[False] or sides[True]:
            differences.append(max(np.mean(of) for of in sides.values() if of))
    return min(differences)


def explain(others: list[Other], suspect: np.ndarray, static: np.ndarray, one_way: bool = False) -> np.ndarray:
    return explained(others, suspect, static, np.full(suspect.shape, one_way))


def test_both_sides_must_show_it() -> None:
    """In two frames what moves may lie where something static would."""
    rgb, inside = clip(), np.zeros(SIZE, bool)
    inside[pole(MIDDLE)] = True
    hidden = rgb.copy()
    hidden[MIDDLE + 1 :] = texture(5, SIZE)
    assert explain(others(rgb, [-1, 1]), inside, WALL)[inside].mean() > 0.9
    assert not explain(others(hidden, [-1, 1]), inside, WALL)[inside].any()
    worse = [other._replace(by_flow=0 * other.by_flow) if other.step < 0 else other for other in others(rgb, [-1, 1])]
    assert explain(worse, inside, WALL)[inside].mean() > 0.9
    assert explain(others(rgb, [-1, -2]), inside, WALL)[inside].mean() > 0.9  # at the end of a clip there is one side


def test_a_camera_that_only_turns_and_no_frames_explain_nothing() -> None:
    rgb, everything = clip(), np.ones(SIZE, bool)
    assert not explain(others(rgb, [-1, 1], way_px=0), everything, WALL).any()
    assert not explain([], everything, WALL).any()


def at_rest(passes_px: int, scene_px: np.ndarray) -> float:
    """Share of a pole that passes by so many px a frame which is explained, where static pixels pass by these [n]."""
    inside = np.zeros(SIZE, bool)
    inside[pole(MIDDLE)] = True
    sights = others(clip(passes_px=passes_px), [-1, 1])
    return float(explain(sights, inside, scene_px / FAR_PX)[inside].mean())


def test_before_a_camera_that_hardly_moves_little_nearer_things_are_searched_for() -> None:
    """What moves along its lines of sight would lie at some depth."""
    assert at_rest(NEAR_PX, np.array([1.02 * HARDLY_PX])) > 0.9
    assert 0.98 * HARDLY_PX * NEARER > NEAR_PX
    assert at_rest(NEAR_PX, np.array([0.98 * HARDLY_PX])) < 0.1
    assert at_rest(3, np.array([0.8 * HARDLY_PX])) > 0.9
    assert at_rest(6, np.array([0.98 * HARDLY_PX])) < 0.1


def test_nothing_is_searched_for_much_nearer_than_the_scene() -> None:
    assert at_rest(17, np.array([1.1 * 17 / NEARER])) > 0.9
    assert at_rest(17, np.array([0.9 * 17 / NEARER])) < 0.1


def test_the_farther_ones_of_the_static_pixels_bound_the_search() -> None:
    some = np.full(100, 0.9 * 17 / NEARER)
    some[:4] *= 50  # wrong depths of a few
    assert at_rest(17, some) < 0.1
    some[:30] *= 2
    assert at_rest(17, some) > 0.9
    assert not explain(others(clip(), [-1, 1]), np.ones(SIZE, bool), np.zeros(0)).any()


@pytest.mark.parametrize("step_px", [-2, 2])
def test_what_moves_before_a_camera_that_hardly_does_still_moves(step_px: int) -> None:
    """A hundredth of a pixel a frame: no depth within reach of the search is half a pixel from infinity."""
    wall, thing = texture(0, SIZE), texture(7, (16, 12))
    inside = np.zeros(SIZE, bool)
    inside[20:36, 70:82] = True
    rgb = np.stack([wall] * T)
    for k in range(T):
        left = 70 + step_px * (k - MIDDLE)
        rgb[k][20:36, left : left + 12] = thing
    sights = [other._replace(by_flow=np.where(inside, 20, 1)) for other in others(rgb, [-2, -1, 1, 2], way_px=0.01)]
    assert explain(sights, inside, np.ones(10))[inside].mean() < 0.2


def test_a_camera_that_turns_and_moves_forward() -> None:
    """A plane at one depth is seen through the homography A + d b e3^T."""
    here, depth, sought = texture(4, SIZE), 0.5, np.zeros(SIZE, bool)
    sought[20:40, 40:110] = True
    turned = cv2.getRotationMatrix2D((75, 30), 2, 1)
    seen = []
    for step in (-1, 1):
        A = np.vstack([turned if step > 0 else cv2.invertAffineTransform(turned), [0, 0, 1]])
        b = step * np.array([10.0 + 75 * 0.2, 30 * 0.2, 0.2])
        H = A + depth * np.outer(b, [0, 0, 1])
        found = cv2.warpPerspective(here, H, SIZE[::-1], borderMode=cv2.BORDER_REFLECT)
        seen.append(Other(step, found, here, np.full(SIZE, 50, np.float32), np.ones(SIZE, bool), A, b))
    assert np.median(least_difference(seen, sought, 2 * depth)[sought]) < 3
    assert np.median(least_difference(seen, sought, depth / 2)[sought]) > 8


def test_what_lies_behind_the_other_camera_is_not_in_view() -> None:
    here = texture(4, SIZE)
    A, b = np.diag([1.0, 1, -1]), np.array([1.0, 0, 0])
    seen = [Other(1, here, here, np.full(SIZE, 50, np.float32), np.ones(SIZE, bool), A, b)]
    assert np.isinf(least_difference(seen, np.ones(SIZE, bool), 1.0)).all()


def test_exposure_is_taken_out() -> None:
    rgb = clip().astype(float)
    rgb[1::2] *= 0.8
    residual, _ = corroborated(rgb.astype(np.uint8))
    assert residual[MIDDLE][pole(MIDDLE)].mean() < 0.1


def test_flow_that_matches_as_well_is_not_replaced() -> None:
    """Some depth matches a little better by chance wherever flow is poor."""
    rgb, inside = clip(noise=3), np.zeros(SIZE, bool)
    inside[pole(MIDDLE)] = True
    assert explain(others(rgb, [-1, 1], by_flow=60.0), inside, WALL)[inside].mean() > 0.9
    assert not explain(others(rgb, [-1, 1], by_flow=5.0), inside, WALL)[inside].any()


def test_what_matches_as_well_as_half_of_the_frame_is_explained() -> None:
    """Through noise nothing matches at half of what the flow leaves."""
    inside = np.zeros(SIZE, bool)
    inside[pole(MIDDLE)] = True
    sights = [other._replace(by_flow=np.where(inside, 25, 30).astype(np.float32)) for other in others(clip(), [-1, 1])]
    assert explain(sights, inside, WALL)[inside].mean() > 0.9


def test_where_edges_run_one_way_a_depth_that_matches_as_well_explains() -> None:
    rgb, inside = clip(noise=3), np.zeros(SIZE, bool)
    inside[pole(MIDDLE)] = True
    by_flow = 12.0  # a depth leaves 10.4, the median over the pole
    assert explain(others(rgb, [-1, 1], by_flow=by_flow), inside, WALL, one_way=True)[inside].mean() > 0.5
    assert explain(others(rgb, [-1, 1], by_flow=by_flow), inside, WALL)[inside].mean() < 0.1
    assert not explain(others(rgb, [-1, 1], by_flow=5.5), inside, WALL, one_way=True)[inside].any()


def test_the_longest_way_to_the_nearest_frames_tells_whether_a_camera_moves() -> None:
    """Forward, it passes what is at the corners by far more than what is in the middle."""
    steps, forward = np.array([-2, -1, 1]), np.array([[40.0, 30, 1]])
    b, scene = np.concatenate([100 * forward, 0.01 * forward, 0.02 * forward]), np.ones(10)
    corner_px = 0.02 * np.hypot(120, 30)  # of a picture of 160 x 60 px, from the epipole to the far side
    assert not hardly_moves(steps, b, 1.01 / corner_px * scene, (60, 160))
    assert hardly_moves(steps, b, 0.99 / corner_px * scene, (60, 160))
    assert hardly_moves(steps, b, np.zeros(0), (60, 160))
    assert hardly_moves(steps[:0], b[:0], scene, (60, 160))
