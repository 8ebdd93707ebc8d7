"""Places seen again: found where the camera returns, and nowhere else."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest

from stages.flow import __main__ as flow_stage
from stages.flow.edges import Edge
from stages.flow.loop_flow import between, loop_flow
from stages.flow.loops import FAR, find_loops, stations
from stages.flow.options import FlowOptions
from stages.shared.artifacts import read_dense, read_metadata, write_json
from stages.shared.sequences import check_sequence, sequence_to_json

H, W, STEP = 96, 160, 10
Clip = tuple[np.ndarray, dict[Edge, np.ndarray]]


def ground(h: int, w: int, seed: int = 0) -> np.ndarray:
    """An image [h, w] uint8 with texture at all scales that nowhere repeats."""
    rng, image = np.random.default_rng(seed), np.zeros((h, w), np.float32)
    for size in (2, 4, 8, 16, 32):
        coarse = rng.normal(size=(h // size + 2, w // size + 2)).astype(np.float32)
        image += cv2.resize(coarse, None, fx=size, fy=size, interpolation=cv2.INTER_CUBIC)[:h, :w]
    return np.clip(128 + 25 * image, 0, 255).astype(np.uint8)


def moved_over(image: np.ndarray, corners: np.ndarray) -> Clip:
    """A window of H x W px on an image, its upper left corner at `corners` [T, 2], with exact flow."""
    grey = np.stack([image[v : v + H, u : u + W] for u, v in corners])
    constant: dict[tuple[int, ...], np.ndarray] = {}
    flow = {}
    for i in range(len(corners)):
        for j in {i - 2, i - 1, i + 1, i + 2} & set(range(len(corners))):
            shift = tuple(corners[i] - corners[j])
            flow[i, j] = constant.setdefault(shift, np.full((H, W, 2), shift, np.float32))
    return grey, flow


def straight(T: int) -> np.ndarray:
    """Upper left corners [T, 2] of a window that moves on and on."""
    return np.stack([STEP * np.arange(T), np.zeros(T, int)], axis=1)


def circuit(T: int) -> np.ndarray:
    """Upper left corners [T, 2] of a window that goes round a square of 20 x 20 steps, one lap in 80 frames."""
    side, along = np.divmod(np.arange(T) % 80, 20)
    starts, ways = np.array([[0, 0], [20, 0], [20, 20], [0, 20]]), np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    return STEP * (starts[side] + along[:, None] * ways[side])


def test_a_place_seen_again_is_found_with_its_matches_and_their_flow() -> None:
    corners = circuit(92)
    grey, flow = moved_over(ground(H + 200, W + 200), corners)
    found = find_loops(grey, flow)
    assert len(found) >= 4
    for (i, j), matches in found:
        assert j - i > FAR
        apart = corners[i] - corners[j]
        assert np.abs(apart).max() < W
        assert np.median(np.linalg.norm(matches[:, 1] - matches[:, 0] - apart, axis=1)) < 0.5
    loop = found[0]
    both = loop_flow(grey, [loop], 0)
    assert set(both) == {loop.pair, loop.pair[::-1]}
    inner = both[loop.pair][30:-30, 40:-40] - (corners[loop.pair[0]] - corners[loop.pair[1]])
    assert np.median(np.linalg.norm(inner, axis=-1)) < 0.2
    ends = [k for (i, j), _ in found for k in (i, j)]
    assert max(ends.count(k) for k in ends) <= 2


@pytest.mark.parametrize("loops", ["auto", "no"])
def test_the_stage_matches_places_seen_again_unless_told_not_to(tmp_path: Path, loops: Literal["auto", "no"]) -> None:
    corners = circuit(92)
    (tmp_path / "clip").mkdir()
    for k, image in enumerate(moved_over(ground(H + 200, W + 200), corners)[0]):
        cv2.imwrite(str(tmp_path / "clip" / f"frame_{k + 1:04d}.png"), image)
    content = tmp_path / "sequence.json"
    write_json(content, sequence_to_json(check_sequence("clip", tmp_path / "clip")))
    options = FlowOptions(offsets=(1, 2), long_edges=0, loops=loops)
    said = flow_stage.main(content, tmp_path / "pairs.arrow", tmp_path / "flow.png", options)
    found = read_dense(tmp_path / "pairs.arrow")
    far = np.abs(found["target"] - found["source"]) > FAR
    assert far.any() == (loops == "auto")
    assert read_metadata(tmp_path / "pairs.arrow")["loops"] == far.sum() / 2  # both ways
    assert ("places seen again" in said) == far.any()
    for k in np.flatnonzero(far).tolist():
        sure = found["confidence"][k] > 0
        apart = corners[found["source"][k]] - corners[found["target"][k]]
        assert np.median(np.linalg.norm(found["flow"][k][sure].astype(float) - apart, axis=-1)) < 0.5


def columns(T: int) -> np.ndarray:
    """A row of equal columns 100 px apart, before plain ground; one at a time is whole in view."""
    image = np.full((H, T * STEP + W), 90, np.uint8)
    column = ground(H, 70, seed=1)
    for u in range(0, image.shape[1] - 70, 100):
        image[:, u : u + 70] = column
    return image


def wall(T: int) -> np.ndarray:
    """A wall of equal stones, 40 px wide and 32 px high."""
    return np.tile(ground(32, 40, seed=2), (3, (T * STEP + W) // 40 + 1))


@pytest.mark.parametrize("made", [columns, wall])
def test_texture_that_repeats_is_no_place_seen_again(made: Callable[[int], np.ndarray]) -> None:
    T = 84
    grey, flow = moved_over(made(T), straight(T))
    assert not find_loops(grey, flow)


def test_a_camera_at_rest_has_one_station_and_one_that_turns_away_no_loop() -> None:
    noise = np.random.default_rng(0).normal(0, 4, (80, H, W))
    grey, flow = moved_over(ground(H, W), np.zeros((80, 2), int))
    assert stations(flow, 80)[0] == [0]
    assert not find_loops(np.clip(grey + noise, 0, 255).astype(np.uint8), flow)
    grey, flow = moved_over(ground(H, 84 * STEP + W), straight(84))
    assert not find_loops(grey, flow)


def test_what_moves_with_the_camera_is_no_place() -> None:
    T = 84
    grey, flow = moved_over(ground(H, T * STEP + W), straight(T))
    mover = (slice(10, 86), slice(30, 110))
    grey[:, *mover] = ground(76, 80, seed=3)
    for of in {id(of): of for of in flow.values()}.values():
        of[mover] = 0
    assert not find_loops(grey, flow)


def test_what_is_burnt_in_is_no_place() -> None:
    """A frame around the picture: any two pictures match there, so that all places would count as repeated."""
    corners = circuit(92)
    grey, flow = moved_over(ground(H + 200, W + 200), corners)
    scene = np.zeros((H, W), bool)
    scene[14:-14, 20:-20] = True
    found = find_loops(np.where(scene, grey, ground(H, W, seed=4)), flow, scene)
    assert len(found) >= 4
    for (i, j), matches in found:
        assert np.median(np.linalg.norm(matches[:, 1] - matches[:, 0] - (corners[i] - corners[j]), axis=1)) < 0.5


def test_short_clips_and_other_shots_have_none() -> None:
    grey, flow = moved_over(ground(H + 200, W + 200), circuit(FAR + 1))
    assert not find_loops(grey, flow)
    image = ground(H, 60 * STEP + W)
    corners = np.concatenate([straight(60), straight(60)])
    grey, flow = moved_over(image, corners)
    for edge in [(i, j) for i, j in flow if min(i, j) < 60 <= max(i, j)]:
        flow[edge] = np.full((H, W, 2), 1e3, np.float32)
    assert not find_loops(grey, flow), "the same film twice, with a cut between"


def test_flow_between_few_matches_is_smooth_and_within_their_range() -> None:
    """Two keypoints at one place, and no more than what a loop needs."""
    rng = np.random.default_rng(0)
    here = rng.uniform((5, 5), (W - 5, H - 5), (25, 2)).astype(np.float32)
    here[1] = here[0]
    there = 1.1 * here + (40, -7)
    flow = between(np.stack([here, there], axis=1), (H, W))
    assert flow.shape == (H, W, 2)
    assert flow.dtype == np.float32
    v, u = np.rint(here).astype(int).T[::-1]
    assert np.abs(flow[v, u] - (there - here)).max() < 2
    assert (flow.min(axis=(0, 1)) >= (there - here).min(axis=0) - 1e-3).all()
    assert (flow.max(axis=(0, 1)) <= (there - here).max(axis=0) + 1e-3).all()
