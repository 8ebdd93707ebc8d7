"""Small things that move fast: dense search loses them, the search for what was lost finds them."""

import cv2
import numpy as np
import pytest

from stages.flow.dis import solve_pair
from stages.flow.edges import Edge, edges_ending
from stages.flow.estimate import Estimate
from stages.flow.lost import with_lost
from stages.given.flow import GivenFlow

SIZE = (120, 200)
STEP = (9, 13)


def texture(seed: int, sigmas: tuple[float, ...] = (1.2, 4.0)) -> np.ndarray:
    """A picture [h, w] uint8 with detail of several sizes."""
    noise = np.random.default_rng(seed).standard_normal(SIZE)
    image = sum(cv2.GaussianBlur(noise, (0, 0), sigma) * sigma for sigma in sigmas)
    return cv2.normalize(image, None, 20, 235, cv2.NORM_MINMAX).astype(np.uint8)


def disc(k: int, radius_px: int = 9) -> np.ndarray:
    """Where [h, w] a ball is in frame k."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    return (y - 40 - STEP[0] * k) ** 2 + (x - 60 - STEP[1] * k) ** 2 <= radius_px**2


def thrown(T: int = 2) -> np.ndarray:
    """Grey frames [T, h, w] of a ball that moves farther per frame than half its width, before ground that rests."""
    ground, ball = texture(0), texture(1)
    frames = []
    for k in range(T):
        moved = np.roll(ball, (STEP[0] * k, STEP[1] * k), (0, 1))
        frames.append(np.where(disc(k), moved, ground))
    return np.stack(frames)


def test_a_ball_that_dense_search_loses_is_found_both_ways() -> None:
    frames = thrown()
    for i, j in ((0, 1), (1, 0)):
        plain = solve_pair(frames[i], frames[j], None, 0)
        found = with_lost(plain, frames[i], frames[j], 0)
        truth = np.array(STEP[::-1]) * (j - i)
        inner = disc(i, 6)
        assert np.median(np.linalg.norm(plain - truth, axis=-1)[inner]) > 5
        assert np.median(np.linalg.norm(found - truth, axis=-1)[inner]) < 0.5
        beyond = ~disc(0, 16) & ~disc(1, 16)
        assert np.array_equal(found[beyond], plain[beyond])


def test_it_is_found_as_far_as_it_is_searched() -> None:
    ground, far = texture(0), (14, 24)  # 28 px
    moved = np.roll(np.where(disc(0), texture(1), 0), far, (0, 1))
    frames = np.where(disc(0), texture(1), ground), np.where(np.roll(disc(0), far, (0, 1)), moved, ground)
    found = with_lost(solve_pair(*frames, None, 0), *frames, 0)
    assert np.median(np.linalg.norm(found - far[::-1], axis=-1)[disc(0, 6)]) < 0.5


@pytest.mark.parametrize(("pan", "brighter"), [(28, 0), (0, 10), (0, -12)])
def test_it_is_found_beside_what_pans_and_under_other_light(pan: int, brighter: int) -> None:
    """The search begins where the flow leads, and light is no difference."""
    first, second = thrown()
    second = np.roll(second, pan, 1)
    target = np.clip(second.astype(int) + brighter, 0, 255).astype(np.uint8)
    plain = solve_pair(first, target, np.tile(np.float32([pan, 0]), (*SIZE, 1)), 0)
    found = with_lost(plain, first, target, 0)
    errors = [np.linalg.norm(flow - (STEP[1] + pan, STEP[0]), axis=-1)[disc(0, 6)] for flow in (plain, found)]
    assert np.median(errors[0]) > 5
    assert np.median(errors[1]) < 0.5


def test_given_flow_is_not_searched_again() -> None:
    class Clip:
        grey, textured, finest_scale = thrown(2), np.ones((2, *SIZE)), 0
        rgb = np.repeat(grey[..., None], 3, axis=-1)

    still = np.zeros((*SIZE, 2), np.float32)
    given = {(0, 1): GivenFlow(still, np.ones(SIZE, bool), None)}
    flow, _ = Estimate(Clip(), (1,), given, threads=1).near([(0, 1), (1, 0)], {})  # type: ignore[arg-type]
    assert np.array_equal(flow[0, 1], still)
    assert np.median(flow[1, 0][disc(1, 6)][:, 0]) < -5


def test_neighbours_are_searched_for_what_was_lost() -> None:
    class Clip:
        grey, textured, finest_scale = thrown(3), np.ones((3, *SIZE)), 0
        rgb = np.repeat(grey[..., None], 3, axis=-1)

    edges: list[Edge] = edges_ending(range(3), (1, 2))
    flow, _ = Estimate(Clip(), (1, 2), {}, threads=1).near(edges, {})  # type: ignore[arg-type]
    assert sorted(flow) == sorted(edges)
    for i, j in ((0, 1), (1, 0), (1, 2), (2, 1)):
        truth = np.array(STEP[::-1]) * (j - i)
        assert np.median(np.linalg.norm(flow[i, j] - truth, axis=-1)[disc(i, 6)]) < 1


def test_what_is_hidden_in_the_other_frame_is_not_matched_by_chance() -> None:
    frames = thrown()
    gone = np.stack([frames[0], texture(0)])  # the ball is in the first frame alone
    plain = solve_pair(*gone, None, 0)
    assert np.array_equal(with_lost(plain, *gone, 0), plain)


@pytest.mark.parametrize("second", ["the same", "brighter", "another picture", "noise"])
def test_pairs_without_anything_lost_keep_their_flow(second: str) -> None:
    first = texture(0)
    noise = 12 * np.random.default_rng(2).standard_normal(SIZE)
    others = {"the same": first, "brighter": first + 15, "another picture": texture(5)}
    target = np.clip(others.get(second, first + noise), 0, 255).astype(np.uint8)
    plain = solve_pair(first, target, None, 0)
    assert np.array_equal(with_lost(plain, first, target, 0), plain)


def test_it_is_found_at_the_edge_of_the_frame() -> None:
    frames = np.roll(thrown(), (-32, -52), (1, 2))
    inner = np.roll(disc(0, 6), (-32, -52), (0, 1))
    inner[:, 60:] = inner[60:] = False
    assert inner[:, 0].any() or inner[0].any() or inner[2].any()
    found = with_lost(solve_pair(*frames, None, 0), *frames, 0)
    assert np.isfinite(found).all()
    assert np.median(np.linalg.norm(found - STEP[::-1], axis=-1)[inner]) < 1
