"""What neighbours alone make of a held-out frame, on motion that is known."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.evaluate import image_baselines, image_metrics
from stages.evaluate.image_baselines import BLEND, NEAREST, WARP
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.score_images import score_images
from stages.shared.artifacts import Dense
from stages.shared.images import write_image
from stages.shared.sequences import Sequence
from stages.shared.split import SplitOptions

H, W, STEP = 48, 64, 3
RNG = np.random.default_rng(0)
WIDE = cv2.GaussianBlur(RNG.integers(0, 256, (H, 3 * W, 3), dtype=np.uint8), (0, 0), 1.5)


def _frame(k: int) -> np.ndarray:
    """A texture that moves 3 pixels to the left per frame."""
    return WIDE[:, W + STEP * k : 2 * W + STEP * k]


@pytest.fixture
def sequence(tmp_path: Path) -> Sequence:
    paths = [tmp_path / f"frame_{k:04d}.png" for k in range(1, 6)]
    for k, path in enumerate(paths):
        write_image(path, _frame(k))
    return Sequence("moving", paths, list(range(1, 6)), W, H)


def test_frames_without_matches_are_not_scored(sequence: Sequence, tmp_path: Path) -> None:
    """Their poses are guesses, and they may show nothing: no method is to be judged by them."""
    for number in (2, 4):
        write_image(tmp_path / f"renders/test/frame_{number:04d}.png", _frame(number))
    options = EvaluateOptions(holdout_every=2, holdout_first=1)
    arguments = (sequence, tmp_path / "renders", _flow(1.0), ({}, "none"), options)
    for unobserved, scored in ((frozenset[int](), 2), (frozenset({2}), 1)):
        rows, of_frames = score_images(*arguments, unobserved)
        assert {row["method"]: row["frames"] for row in rows}["ours"] == scored
        assert {row["method"]: row["frames"] for row in rows}[BLEND] == scored
        assert not unobserved & {row["frame"] for row in of_frames}


def _flow(scale: float) -> Dense:
    """The motion between frames 1 and 3, both ways, on a grid of `scale` times the size."""
    fields = np.zeros((2, round(H * scale), round(W * scale), 2), np.float16)
    fields[0, ..., 0], fields[1, ..., 0] = -2 * STEP * scale, 2 * STEP * scale
    return Dense({"source": np.array([1, 3]), "target": np.array([3, 1]), "flow": fields})


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_flow_warp_of_steady_motion_is_the_frame_itself(sequence: Sequence, scale: float) -> None:
    options = SplitOptions(holdout_every=3, holdout_first=2)
    (made,) = image_baselines.made_frames(sequence, _flow(scale), options)
    assert made.number == 3
    inner = np.s_[:, 2 * STEP : -2 * STEP]
    scores = {
        name: image_metrics.psnr(image[inner] / 255, made.truth[inner] / 255) for name, image in made.images.items()
    }
    np.testing.assert_array_equal(made.images[WARP][inner], made.truth[inner])
    np.testing.assert_array_equal(made.images[NEAREST], _frame(1))
    expected = np.rint((_frame(1).astype(float) + _frame(3)) / 2)
    np.testing.assert_array_equal(made.images[BLEND], expected)
    assert scores[WARP] > scores[BLEND] > 0


def test_without_a_neighbour_or_an_edge_there_is_no_warp(sequence: Sequence) -> None:
    last = SplitOptions(holdout_every=8, holdout_first=4)
    (made,) = image_baselines.made_frames(sequence, _flow(1.0), last)
    assert set(made.images) == {NEAREST, BLEND}
    np.testing.assert_array_equal(made.images[BLEND], _frame(3))
    first = SplitOptions(holdout_every=8, holdout_first=0)
    (made,) = image_baselines.made_frames(sequence, _flow(1.0), first)
    np.testing.assert_array_equal(made.images[NEAREST], _frame(1))


def test_an_uneven_gap_is_mixed_and_warped_by_time() -> None:
    """A third of the way from first to last: motion of 6 px is undone by 2 px in one and 4 px in the other."""
    there, back = np.zeros((H, W, 2), np.float32), np.zeros((H, W, 2), np.float32)
    there[..., 0], back[..., 0] = -6, 6
    first, last = WIDE[:, W : 2 * W], WIDE[:, W + 6 : 2 * W + 6]
    found = image_baselines.between(first, last, there, back, 1 / 3)
    np.testing.assert_array_equal(found[:, 6:-6], WIDE[:, W + 2 : 2 * W + 2][:, 6:-6])
    np.testing.assert_array_equal(image_baselines.mix(first, last, 0.0), first)
