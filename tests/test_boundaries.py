"""Boundaries of masks on pixels: which frames teach the colours of which, and what is held of them."""

import weakref

import numpy as np
import pytest

from stages.segment import boundaries
from stages.segment.boundaries import masks_on_pixels
from stages.segment.colours import Learnt
from stages.segment.options import SegmentOptions

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
        self.masks = list(masks_on_pixels(T, self.picture, lambda k: (sure[k], None), SegmentOptions()))

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
    assert max(clip.held) == (7, 13), "this one and six ahead, and what six behind teach"
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
    for mask, cut in masks_on_pixels(3, lambda _: rgb, lambda _: (wide, None), SegmentOptions()):
        assert cut
        assert mask.mean() <= 0.85


def test_borders_follow_what_pictures_show_and_colours(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures deny the upper half of the square in every other frame, and colours its left half in all."""
    denied, left = np.zeros((H, W), np.float32), np.zeros((H, W), np.float32)
    denied[:20], left[:, :30] = -1, -1
    monkeypatch.setattr(boundaries, "colour_evidence", lambda *_: left)
    known = [(0.7 * SQUARE, denied if k % 2 else None) for k in range(T)]
    rgb = np.kron([[1, 2], [3, 4]], np.full((20, 30), 50))[..., None].repeat(3, axis=2).astype(np.uint8)
    rgb[SQUARE == 0] = 0
    masks = masks_on_pixels(T, lambda _: rgb, known.__getitem__, SegmentOptions())
    for k, (mask, _) in enumerate(masks):
        assert mask[22:28, 32:38].all()
        assert not mask[:, :28].any()
        assert mask[12:18, 32:38].all() != bool(k % 2)
