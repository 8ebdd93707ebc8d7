"""What the pictures give to movers and to the static scene, where flow is lost."""

import weakref

import cv2
import numpy as np
import pytest
from passing_square import (
    GROUND_PX,
    MOVER_PX,
    TILE_PX,
    H,
    T,
    W,
    clip,
    flow_columns,
    left_part,
    square,
    static_world,
    tiles,
)

from stages.segment import layers, matching, uncovered
from stages.segment.layers import MOVING, Belonging, belonging
from stages.segment.permanence import Links, persistent
from stages.segment.static_world import StaticWorld
from stages.segment.superpixels import Superpixels
from stages.shared import flow_pairs
from stages.shared.artifacts import Dense
from stages.shared.flow_pairs import FlowPairs


def evidence(
    contrast: int, ground_px: int = GROUND_PX, darker: float = 1.0, noise: float = 0.0, world: StaticWorld | None = None
) -> tuple[Superpixels, Belonging]:
    """The tiles of a clip and what its pictures say, where the left part of the mover is known.

    Args:
        darker: factor of every frame beside the one before. noise: standard deviation in levels.
    """
    random, frames = np.random.default_rng(6), []
    for k, frame in enumerate(clip(contrast, ground_px)):
        noisy = darker**k * frame + noise * random.standard_normal(frame.shape)
        frames.append(np.rint(np.clip(noisy, 0, 255)).astype(np.uint8))
    pixels, pairs = tiles(), FlowPairs(Dense(flow_columns(ground_px)))
    sure = pixels.means(np.stack([left_part(k) for k in range(T)]).astype(float)).round()
    return pixels, belonging(pixels, pairs, lambda k: frames[k], world or static_world(ground_px), sure)


def inner(mask: np.ndarray) -> np.ndarray:
    """A mask [H, W] without 8 px at its border, where tiles are mixed."""
    return cv2.erode(mask.astype(np.uint8), np.ones((17, 17), np.uint8)) > 0


@pytest.mark.parametrize("darker", [1.0, 0.93])
def test_what_moves_with_a_known_part_is_given_to_the_mover(darker: float) -> None:
    """In any light: pictures are compared as if all had the same exposure."""
    pixels, found = evidence(contrast=60, darker=darker)
    for k in range(T):
        shown = pixels.paint(found.weight, k)
        assert np.median(shown[inner(square(k) & ~left_part(k))]) > 0.1 * MOVING


@pytest.mark.parametrize("ground_px", [GROUND_PX, 0])
def test_ground_beside_a_mover_is_given_to_the_static_scene(ground_px: int) -> None:
    """Also before a camera at rest: where nothing is known of a mover, its motion is not that of the ground."""
    pixels, found = evidence(contrast=60, ground_px=ground_px)
    for k in range(T):
        shown = pixels.paint(found.weight, k)
        near = np.zeros((H, W), bool)
        near[24:72, 92 + MOVER_PX * k : 120 + MOVER_PX * k] = True
        assert np.median(shown[inner(near)]) < 0
        assert (shown[inner(~square(k))] <= 0).all()
        assert (shown[:, :20] == 0).all(), "far from the mover its motion says nothing"


def test_noise_does_not_hide_what_moves_with_a_known_part() -> None:
    """Right matches differ by the noise, which is measured along the flow: it is no residual of a wrong motion."""
    pixels, found = evidence(contrast=60, noise=10)
    for k in range(T):
        shown = pixels.paint(found.weight, k)
        assert np.median(shown[inner(square(k) & ~left_part(k))]) > 0.1 * MOVING
        assert (shown[inner(~square(k))] <= 0).all()


@pytest.mark.parametrize("fits", [True, False])
def test_ground_that_was_masked_by_mistake_is_static_where_its_flow_says_so(fits: bool) -> None:
    """Its depth in the adjustment is then that of a mover, at which the pictures of the ground do not match."""
    wall, near = np.ones((H, W), np.float32), np.full((H, W), 3, np.float32)
    masked, fitted = static_world()._replace(inverse_depth=lambda _: near), np.full((H, W), fits)
    pixels, found = evidence(contrast=60, world=masked._replace(as_static=lambda _: (wall, fitted)))
    for k in range(T):
        beside = np.zeros((H, W), bool)
        beside[24:72, 92 + MOVER_PX * k : 120 + MOVER_PX * k] = True
        assert (np.median(pixels.paint(found.weight, k)[inner(beside)]) < 0) == fits
        assert np.median(pixels.paint(found.weight, k)[inner(square(k) & ~left_part(k))]) > 0.1 * MOVING


def test_what_pictures_show_fades_away_from_a_mover() -> None:
    """The farther its motion is extended, the less it says."""
    pixels, found = evidence(contrast=60)
    for k in range(T):
        left = 120 + MOVER_PX * k
        for shown in (pixels.paint(found.weight, k), found.of_frame(k)):
            near, far = (np.median(shown[32:64, left - px : left - px + 8]) for px in (14, 30))
            assert near < 2.5 * far < 0


def test_without_texture_nothing_is_given_to_either() -> None:
    _, found = evidence(contrast=0)
    assert (found.weight == 0).all()
    assert (found.pixels == 0).all()


def test_pixels_are_told_apart_within_a_superpixel() -> None:
    """Tiles of 8 px at the border of the mover hold ground as well; a pixel 3 px from the border is still told."""
    _, found = evidence(contrast=60)
    u, told = np.arange(W), {True: [], False: []}
    for k in range(T):
        left = 120 + MOVER_PX * k
        if left % TILE_PX in (3, 4, 5):
            mixed = slice(left // TILE_PX * TILE_PX, (left // TILE_PX + 1) * TILE_PX)
            rows = found.of_frame(k)[32:64, mixed]
            for moves in (True, False):
                told[moves] += [rows[:, (u[mixed] - left >= 3) if moves else (left - u[mixed] >= 3)]]
    moving, resting = (np.concatenate([part.ravel() for part in told[moves]]) for moves in (True, False))
    assert np.median(moving) > 0.5
    assert np.median(resting) < -0.5


@pytest.mark.parametrize("left", [136, 100])
def test_a_pixel_that_neither_explains_is_given_to_neither(left: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Flicker on the mover or beside it: one motion matches a little better by chance."""
    random, frames = np.random.default_rng(1), clip(60)
    flicker = np.zeros((H, W), bool)
    flicker[32:64, left : left + 20] = True
    frames[:, flicker] = random.integers(0, 256, (T, int(flicker.sum()), 3))
    monkeypatch.setattr("test_mover_layers.clip", lambda *_: frames)
    _, found = evidence(contrast=60)
    inside = cv2.erode(flicker.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert np.abs(np.stack([found.of_frame(k)[inside] for k in range(T)])).mean() < 0.01


def test_pictures_of_a_long_clip_are_held_a_block_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of five frames in blocks of one, each seen with those beside it, where its flow is unsure; each is read once."""
    frames, pixels, known = clip(60), tiles(), flow_columns()
    near = np.abs(known["source"] - known["target"]) == 1
    unsure = np.zeros_like(known["confidence"][near])
    pairs = FlowPairs(Dense({name: values[near] for name, values in known.items()} | {"confidence": unsure}))
    sure = pixels.means(np.stack([left_part(k) for k in range(T)]).astype(float)).round()

    def found(read: list[int], held: list[int]) -> np.ndarray:
        alive: list[weakref.ref[np.ndarray]] = []

        def picture(k: int) -> np.ndarray:
            frame = frames[k].copy()
            alive.append(weakref.ref(frame))
            read.append(k)
            held.append(sum(of() is not None for of in alive))
            return frame

        shown = belonging(pixels, pairs, picture, static_world(), sure)
        return np.concatenate([shown.weight, shown.pixels.ravel()])

    read: list[int] = []
    held: list[int] = []
    monkeypatch.setattr(layers, "DISTANCES", (1,))
    monkeypatch.setattr(uncovered, "DISTANCES", (1,))
    whole = found([], [])
    monkeypatch.setattr(flow_pairs, "BLOCK", 1)
    monkeypatch.setattr(layers, "REACH", 1)
    np.testing.assert_array_equal(found(read, held), whole)
    assert sorted(read) == list(range(T))
    assert max(held) == 4  # the frame before and those beside it, and the next one


def test_what_is_far_from_movers_need_not_be_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    """Around a mover there is as much evidence as where the whole frame is compared."""
    frames, pixels = clip(60), tiles()
    sure = pixels.means(np.stack([square(k) for k in range(T)]).astype(float)).round()
    parts: list[tuple[slice, slice]] = []

    def found() -> Belonging:
        return belonging(pixels, FlowPairs(Dense(flow_columns())), lambda k: frames[k], static_world(), sure)

    bounds = matching._bounds
    monkeypatch.setattr(matching, "_bounds", lambda mask: parts.append(bounds(mask)) or parts[-1])
    beside = found()
    monkeypatch.setattr(matching, "_bounds", lambda _: np.s_[:H, :W])
    whole = found()
    for part, of in zip(beside[:3], whole[:3], strict=True):
        np.testing.assert_allclose(part.astype(float), of, atol=0.002)
    near = np.repeat(whole.evidence[:, None, 4] > 25, 6, axis=1)  # a tenth of what is around is a mover's
    np.testing.assert_allclose(beside.evidence[near].astype(float), whole.evidence[near], atol=1)
    assert near.mean() > 0.1
    assert max((rows.stop - rows.start) * (columns.stop - columns.start) for rows, columns in parts) < 0.8 * H * W


def test_the_evidence_in_parts_changes_nothing_else() -> None:
    """Where it is not asked for it takes no memory either."""
    frames, pixels = clip(60), tiles()
    sure = pixels.means(np.stack([square(k) for k in range(T)]).astype(float)).round()
    given = pixels, FlowPairs(Dense(flow_columns())), lambda k: frames[k], static_world(), sure
    with_parts, without = belonging(*given), belonging(*given, in_parts=False)
    for one, other in zip(with_parts[:3], without[:3], strict=True):
        np.testing.assert_array_equal(one, other)
    assert with_parts.in_parts(0) is not None
    assert without.in_parts(0) is None
    assert without.evidence.nbytes == 0


def test_where_nothing_is_known_to_move_there_is_no_evidence() -> None:
    frames = clip(60)
    pixels = tiles()
    pairs = FlowPairs(Dense(flow_columns()))
    found = belonging(pixels, pairs, lambda k: frames[k], static_world(), np.full(len(pixels.areas), 0.4))
    assert (found.weight == 0).all()
    assert (found.pixels == 0).all()


def test_a_mover_is_not_lost_by_what_the_pictures_add_to_it() -> None:
    """Where they add much whose flow is unsure, the mean evidence of its flow falls."""
    frames, pixels, columns = clip(60), tiles(), flow_columns()
    known = [square(k) & (np.arange(W) < 144 + MOVER_PX * k) for k in range(T)]
    sure = [np.where(known[k], 0.3, np.where(square(k), 0.03, 0.6)) for k in range(T)]
    for e, i in enumerate(columns["source"]):
        columns["confidence"][e][square(i) & ~known[i]] = 0
    prior, confidence = pixels.means(np.stack(known).astype(float)), pixels.means(np.stack(sure))
    given = Links(pixels, columns, 1.0), prior, confidence, 0.4
    before, _ = persistent(*given)
    pairs = FlowPairs(Dense(columns))
    shown = belonging(pixels, pairs, lambda k: frames[k], static_world(), before)
    after, instance = persistent(*given, None, shown.weight)
    found = [pixels.paint(of, 2) >= 0.5 for of in (before, after)]
    assert instance.max() == 1
    assert (found[1] & square(2)).sum() > 1.3 * (found[0] & square(2)).sum() > 0


def test_a_logo_beside_a_mover_is_no_part_of_it() -> None:
    """What is burnt in rests in the image, and so fits no motion of the scene."""
    logo = np.zeros((H, W), bool)
    logo[36:60, 88:104] = True
    frames = clip(60)
    frames[:, logo] = cv2.GaussianBlur(np.random.default_rng(5).integers(0, 255, (H, W, 3), np.uint8), (0, 0), 1)[logo]
    columns, pixels = flow_columns(), tiles()
    columns["flow"][:, logo] = 0
    pairs = FlowPairs(Dense(columns), scene=~logo)
    sure = pixels.means(np.stack([left_part(k) for k in range(T)]).astype(float)).round()
    weight = belonging(pixels, pairs, lambda k: frames[k], static_world(), sure).weight
    for k in range(T):
        shown = pixels.paint(weight, k)
        assert (shown[inner(logo)] == 0).all()
        around = cv2.dilate(logo.astype(np.uint8), np.ones((17, 17), np.uint8)) > 0
        assert shown[around & inner(~square(k))].max() < 0.1 * MOVING


def test_pictures_are_not_asked_in_frames_that_movers_fill() -> None:
    """Cameras may follow a mover there, which then seems to rest."""
    _, some = evidence(contrast=60)
    assert some.asked.mean() > 0.3
    frames, pixels = clip(60), tiles()
    everywhere = np.ones(len(pixels.areas))
    filled = belonging(pixels, FlowPairs(Dense(flow_columns())), lambda k: frames[k], static_world(), everywhere)
    assert (filled.asked == 0).all()


@pytest.mark.parametrize("hole", [30, 55])
def test_ground_behind_a_wide_mover_has_the_depth_of_its_plane(hole: int) -> None:
    """The adjustment gives what was masked the depth of a mover, and a mean of the ground around it is too near."""
    v = np.mgrid[:H, :W][0]
    plane = (0.1 + 0.01 * np.maximum(v - 20, 0)).astype(np.float32)
    masked = np.zeros((H, W), bool)
    masked[24:80, 80 : 80 + hole] = True
    solved = np.where(masked, np.float32(1.5), plane)
    world = static_world()._replace(inverse_depth=lambda _: solved, as_static=lambda _: (solved, ~masked))
    depths = matching.static_depths(world, 0, 1.0 - masked)
    nearest = np.min([np.abs(depth / plane - 1) for depth in depths], axis=0)
    assert np.mean(nearest[masked & (v > 40)] < 0.02) > 0.9
    rim = masked & (cv2.erode(masked.astype(np.uint8), np.ones((9, 9), np.uint8)) == 0) & (v > 40)
    np.testing.assert_allclose(depths[0][rim], plane[rim], rtol=0.02, err_msg="its own: that of the narrowest plane")
    fitted = np.where(masked, np.float32(np.inf), plane)  # an overflow of float16, where nothing fits
    lost = world._replace(as_static=lambda _: (fitted, ~masked))
    np.testing.assert_array_equal(matching.static_depths(lost, 0, np.ones((H, W)))[-1], depths[-1])
    moves = world._replace(as_static=lambda _: (solved, np.ones((H, W), bool)))
    np.testing.assert_array_equal(
        matching.static_depths(moves, 0, 1.0 - masked)[-1], depths[-1], err_msg="of what rests"
    )
