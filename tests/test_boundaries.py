"""Boundaries of masks on pixels: which frames teach the colours of which, and what is held of them."""

import weakref

import cv2
import numpy as np
import pytest

from stages.segment import boundaries
from stages.segment.boundaries import bounded, maps_of, masks_on_pixels
from stages.segment.colours import ASKED_PX, Learnt
from stages.segment.network import STEPS, Network
from stages.segment.options import SegmentOptions
from stages.segment.refined import Known
from stages.shared.images import reduced_size

T, H, W = 20, 40, 60
SQUARE = np.zeros((H, W))
SQUARE[10:30, 20:40] = 1
RAMP = np.tile(np.linspace(0.55, 1, W), (H, 1))
"""Nearly all of the frame, more than a mask may hold."""


class Clip:
    """Frames of one level each: which teach the colours of each, and how many frames and lessons are held then."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *nearly_full: int) -> None:
        self.read: list[weakref.ref[np.ndarray]] = []
        self.taught: dict[int, list[int]] = {}
        self.learnt: list[weakref.ref[np.ndarray]] = []
        self.held: list[tuple[int, int]] = []
        monkeypatch.setattr(boundaries, "learn", self.learn)
        monkeypatch.setattr(boundaries, "colour_evidence", self.evidence)
        sure = {k: RAMP if k in nearly_full else SQUARE for k in range(T)}
        self.masks = list(masks_on_pixels(T, self.picture, lambda k: Known(sure[k]), SegmentOptions()))

    def picture(self, k: int) -> np.ndarray:
        """Frame k, which must be asked for after the one before it."""
        assert k == len(self.read)
        frame = np.full((H, W, 3), 10 * k, np.uint8)
        self.read.append(weakref.ref(frame))
        return frame

    def learn(self, sureness: np.ndarray, rgb: np.ndarray) -> Learnt:
        """The number of the frame."""
        number = rgb[0, 0] // 10
        self.learnt.append(weakref.ref(number))
        return Learnt(number, sureness)

    def evidence(self, sureness: np.ndarray, rgb: np.ndarray, own: Learnt, others: list[Learnt]) -> np.ndarray:
        """Nothing."""
        k = int(own.lab[0])
        assert (rgb == 10 * k).all()
        self.taught[k] = [int(of.lab[0]) for of in others]
        frames, learnt = (sum(of() is not None for of in some) for some in (self.read, self.learnt))
        self.held.append((frames, learnt))
        return np.zeros(sureness.shape, np.float32)


def near(k: int) -> list[int]:
    """Frames that teach the colours of frame k."""
    return [j for j in (k - 6, k - 3, k + 3, k + 6) if 0 <= j < T]


def test_frames_near_by_teach_and_those_past_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    clip = Clip(monkeypatch)
    assert len(clip.read) == len(clip.masks) == T
    assert clip.taught == {k: near(k) for k in range(T)}
    assert max(clip.held) == (8, 13), "the one before, this one and six ahead, and what six behind teach"
    assert not any(cut for _, cut in clip.masks)


def test_a_frame_that_is_cut_back_neither_learns_nor_teaches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its surest part is wanted, and not that of the clearest colours; most of what it masks is wrong."""
    clip = Clip(monkeypatch, 7, 8)
    assert [cut for _, cut in clip.masks] == [k in (7, 8) for k in range(T)]
    assert clip.taught == {k: [j for j in near(k) if j not in (7, 8)] for k in range(T) if k not in (7, 8)}


def test_a_mask_that_colours_make_nearly_full_is_cut_back(monkeypatch: pytest.MonkeyPatch) -> None:
    wide = np.zeros((H, W))
    wide[:, :48] = 0.8
    widened = np.linspace(0.5, 1, W, dtype=np.float32)[None].repeat(H, axis=0)
    monkeypatch.setattr(boundaries, "colour_evidence", lambda *_: widened)
    rgb = np.zeros((H, W, 3), np.uint8)
    for mask, cut in masks_on_pixels(3, lambda _: rgb, lambda _: Known(wide), SegmentOptions()):
        assert cut
        assert mask.mean() <= 0.85


def test_borders_follow_what_pictures_show_and_colours(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures deny the upper half of the square in every other frame, and colours its left half in all."""
    denied, left = np.zeros((H, W), np.float32), np.zeros((H, W), np.float32)
    denied[:20], left[:, :30] = -1, -1
    monkeypatch.setattr(boundaries, "colour_evidence", lambda *_: left)
    known = [Known(0.7 * SQUARE, denied if k % 2 else None) for k in range(T)]
    rgb = np.kron([[1, 2], [3, 4]], np.full((20, 30), 50))[..., None].repeat(3, axis=2).astype(np.uint8)
    rgb[SQUARE == 0] = 0
    masks = masks_on_pixels(T, lambda _: rgb, known.__getitem__, SegmentOptions())
    for k, (mask, _) in enumerate(masks):
        assert mask[22:28, 32:38].all()
        assert not mask[:, :28].any()
        assert mask[12:18, 32:38].all() != bool(k % 2)


def told(bias: float) -> Network:
    """A network that says of every pixel it is asked about that it moves, or, below 0, that it does not."""
    count = 4 + 2 + 8 + 3
    shapes = (1, count), (1,), (len(STEPS), 1, 1, 3, 3), (len(STEPS), 1), (1,)
    return Network(*(np.zeros(shape, np.float32) for shape in shapes), np.float32([bias]))


@pytest.mark.parametrize("bias", [60.0, -60.0, 0.0])
def test_the_network_decides_near_borders_where_pictures_were_asked(bias: float) -> None:
    """Pixels at most 5 px from the border of the square; no others, and none of frames that are cut back."""
    rgb = np.repeat((200 * SQUARE[..., None]).astype(np.uint8), 3, axis=2)
    shown, evidence = np.zeros((H, W)), np.zeros((8, H, W), np.float32)
    known = Known(SQUARE, shown, evidence), Known(SQUARE), Known(RAMP, shown, evidence)

    def masks(network: Network | None) -> list[np.ndarray]:
        return [mask for mask, _ in masks_on_pixels(3, lambda _: rgb, known.__getitem__, SegmentOptions(), network)]

    before, found = masks(None), masks(told(bias))
    near = np.ones((2 * int(ASKED_PX * W / 512) + 3,) * 2)
    outer, inner = (op(before[0].astype(np.uint8), near) for op in (cv2.dilate, cv2.erode))
    if bias > 0:
        assert found[0].sum() > 1.5 * before[0].sum()
        assert not found[0][outer == 0].any()
    elif bias < 0:
        assert found[0].sum() < 0.5 * before[0].sum()
        assert found[0][inner > 0].all()
    for k in (0, 1, 2) if bias == 0 else (1, 2):
        np.testing.assert_array_equal(found[k], before[k])


@pytest.mark.parametrize(
    ("width", "height", "side"), [(1106, 1050, 516), (1106, 1050, 700), (300, 500, 512), (90, 70, 45)]
)
def test_frames_and_grids_of_any_size_fit(width: int, height: int, side: int) -> None:
    """What is reduced to the grid, and from there to what the network sees, may lack a row."""
    w, h = reduced_size(width, height, side)
    grid, rgb = np.full((h, w), 0.4), np.zeros((height, width, 3), np.uint8)
    (frame,) = bounded(1, lambda _: rgb, lambda _: Known(grid, grid, np.full((8, h, w), 0.4)), SegmentOptions())
    maps = maps_of(frame)
    assert maps.shape[:0:-1] == reduced_size(width, height, 512)
    np.testing.assert_allclose(
        maps[4:14], np.array([-0.2, 0.4] + 8 * [-0.2])[:, None, None] * np.ones(maps.shape[1:]), atol=1e-5
    )


def test_each_map_is_told_its_own() -> None:
    """Maps of one value each: none stands for another."""
    evidence = np.stack([np.full((H, W), k / 10) for k in range(8)])
    (frame,) = bounded(
        1,
        lambda _: np.full((H, W, 3), 128, np.uint8),
        lambda _: Known(SQUARE, 0.3 * SQUARE, evidence),
        SegmentOptions(),
    )
    maps = maps_of(frame._replace(colours=np.full((H, W), -0.7, np.float32)))
    middle = maps[:, H // 2, W // 2]
    assert middle[[2, 4, 5]] == pytest.approx([-0.7, 1, 0.3])
    assert middle[6:14] == pytest.approx(2 * np.arange(8) / 10 - 1)
    assert middle[14:] == pytest.approx([0.28, 0, 0], abs=0.05)


def test_what_the_network_is_told_fits_the_pixels() -> None:
    """A square lies at one place, on the grid of the flow, of half the width, and in frames that are reduced."""
    for scale in (1, 20):
        grid, full = (SQUARE[::2, ::2], np.kron(SQUARE, np.ones((scale, scale))))
        rgb = np.repeat((60 + 120 * full[..., None]).astype(np.uint8), 3, axis=2)
        known = Known(grid, grid, np.stack([grid] * 8).astype(np.float32))
        (frame,) = bounded(1, lambda _: rgb, lambda _: known, SegmentOptions())  # noqa: B023
        maps = maps_of(frame)
        small = cv2.resize(full.astype(np.float32), maps.shape[:0:-1], interpolation=cv2.INTER_AREA)
        assert max(maps.shape[1:]) == min(scale * W, 512)
        assert maps.dtype == np.float32
        sides = (
            cv2.erode((small > 0.99).astype(np.uint8), np.ones((5, 5))),
            cv2.erode((small < 0.01).astype(np.uint8), np.ones((5, 5))),
        )
        for map_of in (maps[0], maps[1], maps[3], maps[4], *maps[6:14], maps[14]):
            assert map_of[sides[0] > 0].min() > map_of[sides[1] > 0].max()
