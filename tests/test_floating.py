"""The side of a tram beside its front, which is found: it floats before a wall and the ground below."""

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import pytest

from stages.segment.floating import LEAST, floating
from stages.segment.permanence import Links
from stages.segment.superpixels import Superpixels

T, H, W, TILE_PX = 5, 96, 160, 8
FRONT, SIDE = (slice(24, 64), slice(40, 72)), (slice(24, 64), slice(72, 112))


class World:
    """A wall, and ground that comes nearer from row 48 on; before them, things [(rows, columns), inverse depth]."""

    def __init__(self, things: Sequence[tuple[tuple[slice, slice], float]]) -> None:
        self.depth = np.where(np.arange(H) < 48, 0.2, 0.2 + 0.01 * (np.arange(H) - 48))[:, None] * np.ones(W)
        for place, inverse_depth in things:
            self.depth[place] = inverse_depth

    def inverse_depth(self, _: int) -> np.ndarray:
        return self.depth.astype(np.float32)


def shown(
    things: Sequence[tuple[tuple[slice, slice], float]],
    found: Sequence[tuple[slice, slice] | None],
    permanence: float = 1.0,
    hole: tuple[slice, slice] | None = None,
) -> np.ndarray:
    """Where [T, H, W] bool something floats and hangs on what is found in each of T frames. All is seen at rest."""
    v, u = np.mgrid[:H, :W] // TILE_PX
    labels, count = v * (W // TILE_PX) + u, H * W // TILE_PX**2
    first = count * np.arange(T + 1)
    colours = np.full((first[-1], 3), 100.0)
    pixels = Superpixels(np.stack(T * [labels]).astype(np.uint16), first, np.full(first[-1], TILE_PX**2), colours)
    source, target = np.array([(i, j) for i in range(T) for j in range(T) if abs(i - j) == 1]).T
    pairs = {"source": source, "target": target, "flow": np.zeros((len(source), H, W, 2), np.float32)}
    pairs["confidence"] = np.ones(pairs["flow"].shape[:3], np.float32)
    masks = np.zeros((T, H, W))
    for mask, place in zip(masks, found, strict=True):
        if place is not None:
            mask[place] = 1
        if hole is not None:
            mask[hole] = 0
    hangs = floating(Links(pixels, pairs, permanence), cast(Any, World(things)), pixels.means(masks))
    return np.stack([pixels.paint(hangs, k) for k in range(T)])


def place(where: tuple[slice, slice]) -> np.ndarray:
    """A mask [T, H, W] of a place in all frames."""
    mask = np.zeros((T, H, W), bool)
    mask[:, where[0], where[1]] = True
    return mask


@pytest.mark.parametrize("front", [0.2, 0.8])
def test_the_side_of_a_tram_floats_beside_its_front(front: float) -> None:
    """Whatever the depth is that is guessed for the front; and nothing else does."""
    np.testing.assert_array_equal(shown([(FRONT, front), (SIDE, 0.8)], T * [FRONT]), place(SIDE))


def test_what_stands_on_the_ground_does_not_float() -> None:
    """Its foot is at the depth of the ground: a kiosk that someone stands before."""
    assert not shown([(SIDE, 0.34)], T * [FRONT]).any()
    assert shown([(SIDE, 0.5)], T * [FRONT]).any()


def test_what_hangs_alone_or_from_the_border_is_no_part_of_a_mover() -> None:
    away = slice(24, 64), slice(96, 136)
    assert not shown([(away, 0.8)], T * [FRONT]).any()
    assert not shown([((slice(0, 64), SIDE[1]), 0.8)], T * [FRONT]).any()


def test_a_thing_that_a_mover_passes_is_no_part_of_it() -> None:
    """It adjoins it in one frame, and floats there, but not in those around; how strong links are does not matter."""
    for permanence in (1.0, 0.01):
        assert not shown([(SIDE, 0.8)], [None, None, FRONT, None, None], permanence).any()
        assert shown([(SIDE, 0.8)], [None, FRONT, FRONT, FRONT, None], permanence)[2].any()


def test_what_is_found_in_the_frames_around_agrees() -> None:
    whole = FRONT[0], slice(FRONT[1].start, SIDE[1].stop)
    hangs = shown([(SIDE, 0.8)], [whole, whole, FRONT, whole, whole])
    np.testing.assert_array_equal(hangs, place(SIDE) & (np.arange(T) == 2)[:, None, None])


def test_a_long_clip_is_worked_on_window_by_window(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stages.segment.permanence.WINDOW", 3)
    monkeypatch.setattr("stages.segment.permanence.OVERLAP", 1)
    test_the_side_of_a_tram_floats_beside_its_front(0.8)


def test_what_is_seen_through_a_mover_is_behind_it() -> None:
    assert not shown([(SIDE, 0.05)], T * [FRONT]).any()


@pytest.mark.parametrize("inverse_depth", [0.05, 0.8])
def test_what_a_mover_encloses_is_seen_through_it(inverse_depth: float) -> None:
    """Ground between legs lies before nothing, as nothing else is beside it."""
    assert not shown([(SIDE, inverse_depth)], T * [(slice(16, 72), slice(40, 120))], hole=SIDE).any()


@pytest.mark.parametrize(("tiles", "hangs"), [(LEAST - 1, False), (LEAST, True)])
def test_a_rim_is_no_part(tiles: int, hangs: bool) -> None:
    rim = slice(24, 24 + TILE_PX * tiles), slice(72, 80)
    front = slice(16, 80), FRONT[1]
    assert shown([(rim, 0.9)], T * [front]).any() == hangs


def test_what_touches_a_mover_at_one_end_only_is_no_part() -> None:
    """A long sign whose end someone passes."""
    sign = slice(24, 32), slice(72, 152)
    assert not shown([(sign, 0.8)], T * [FRONT]).any()


def test_most_of_a_frame_is_no_part() -> None:
    scene = slice(8, 88), slice(72, 152)
    assert not shown([(scene, 2.0)], T * [(slice(8, 88), FRONT[1])]).any()
