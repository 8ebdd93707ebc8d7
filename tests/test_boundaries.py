"""Boundaries of masks on pixels: which frames teach the colours of which, and what is read of them."""

import numpy as np
import pytest

from stages.segment import boundaries
from stages.segment.boundaries import Boundaries
from stages.segment.colours import Learnt
from stages.segment.options import SegmentOptions

T, H, W = 16, 40, 60


def grey(k: int) -> np.ndarray:
    """Frame k [H, W, 3], of one level that no other frame has."""
    return np.full((H, W, 3), 10 * k, np.uint8)


def asked(monkeypatch: pytest.MonkeyPatch, sure: np.ndarray) -> tuple[list[int], dict[int, list[int]], list[bool]]:
    """Of a clip of frames that are this sure [H, W]: which are read, which teach each, and which are cut back."""
    read: list[int] = []
    taught: dict[int, list[int]] = {}

    def picture(k: int) -> np.ndarray:
        read.append(k)
        return grey(k)

    def evidence(sureness: np.ndarray, rgb: np.ndarray, others: list[Learnt]) -> np.ndarray:
        taught[int(rgb[0, 0, 0]) // 10] = [int(of.lab[0, 0, 0]) for of in others]
        return np.zeros(sureness.shape, np.float32)

    monkeypatch.setattr(boundaries, "learn", lambda sureness, rgb: Learnt(rgb // 10, sureness))
    monkeypatch.setattr(boundaries, "colour_evidence", evidence)
    clip = Boundaries(T, picture, lambda _: sure, lambda _: None, SegmentOptions())
    return read, taught, [clip.mask(k)[1] for k in range(T)]


def test_frames_near_by_teach_and_each_is_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    sure = np.zeros((H, W))
    sure[10:30, 20:40] = 1
    read, taught, cut = asked(monkeypatch, sure)
    assert sorted(read) == list(range(T))
    assert taught == {k: [j for j in (k - 6, k - 3, k + 3, k + 6) if 0 <= j < T] for k in range(T)}
    assert not any(cut)


def test_colours_say_nothing_of_a_frame_that_is_cut_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its surest part is wanted, and not that of the clearest colours."""
    sure = np.tile(np.linspace(0.55, 1, W), (H, 1))
    _, taught, cut = asked(monkeypatch, sure)
    assert not taught
    assert all(cut)
