"""Subtraction of the background: the kernel against numpy, and what stands out."""

import cv2
import numpy as np
import pytest
from test_uncovered import GROUND_PX, MIDDLE, H, T, W, around, between, clip, evidence, inner, legs, turning, world

from stages.segment import uncovered
from stages.segment.background import LEAST_FRAMES, against_background

GROUND, ALL = np.ones((H, W), np.float32), np.ones((H, W), bool)


def test_what_stands_out_from_the_ground_is_told_from_it() -> None:
    """Also where no motion of the walker is known: the ground is the same in the other frames, the legs are not."""
    covered = {k: between(k, 9) for k in range(T)}
    apart, spread = against_background(GROUND, ALL, around([GROUND], clip(9), covered, world()))
    walker, ground = inner(legs(MIDDLE, 9)), cv2.dilate(between(MIDDLE, 9).astype(np.uint8), np.ones((5, 5))) == 0
    walker[:, :24] = walker[:, -24:] = ground[:, :24] = ground[:, -24:] = False
    assert np.percentile(apart[walker], 10) > 4 * np.percentile(apart[ground], 90)
    assert np.median(spread[walker]) < np.median(apart[walker]) / 3


def test_what_too_few_frames_show_stands_out_from_nothing() -> None:
    near = [MIDDLE - 2, MIDDLE - 1, MIDDLE + 1, MIDDLE + 2]
    for shown in (near[: LEAST_FRAMES - 1], near[:LEAST_FRAMES]):
        covered = {k: np.full((H, W), k not in shown) for k in range(T)}
        apart, spread = against_background(0 * GROUND, ALL, around([GROUND], clip(9), covered, world()))
        assert (apart > 0).any() == (spread > 0).any() == (len(shown) >= LEAST_FRAMES)


def test_the_kernel_is_mean_and_deviation_over_uncovered_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pixel by pixel in numpy, for a camera that turns and moves on."""
    monkeypatch.setattr(uncovered, "exposed", lambda frame, _: frame)
    random = np.random.default_rng(3)
    seen, frames, covered = turning(random)
    depth = random.uniform(0.2, 1.2, (H, W)).astype(np.float32)
    asked = random.random((H, W)) < 0.9
    apart, spread = against_background(depth, asked, around([depth], frames, covered, seen))
    blurred = {k: cv2.blur(frame, (3, 3)).astype(float) for k, frame in frames.items()}
    for v, u in random.integers((12, 60), (H - 12, W - 60), (40, 2)):
        found = []
        for j in (MIDDLE + o for distance in uncovered.DISTANCES for o in (-distance, distance)):
            if j not in frames:
                continue
            A, b = seen.projection(MIDDLE, j)
            x, y, z = A @ [u, v, 1] + depth[v, u] * b
            x, y = x / z, y / z
            left, top = int(np.floor(x)), int(np.floor(y))
            if covered[j][top : top + 2, left : left + 2].any():
                continue
            part, dx, dy = blurred[j][top : top + 2, left : left + 2], x - left, y - top
            rows = part[0] * (1 - dy) + part[1] * dy
            found.append(rows[0] * (1 - dx) + rows[1] * dx - blurred[MIDDLE][v, u])
        known = len(found) >= LEAST_FRAMES and asked[v, u]
        np.testing.assert_allclose(apart[v, u], np.abs(np.mean(found, axis=0)).mean() if known else 0, rtol=1e-3)
        np.testing.assert_allclose(spread[v, u], np.std(found, axis=0).mean() if known else 0, rtol=1e-3)


def test_frames_at_rest_show_nothing() -> None:
    """The ground alone, which the camera passes."""
    frames = clip(9)
    still = {k: np.roll(frames[0], GROUND_PX * k, axis=1) for k in range(T)}
    none = {k: np.zeros((H, W), bool) for k in range(T)}
    apart, spread = against_background(GROUND, ALL, around([GROUND], still, none, world()))
    assert apart[:, 40:-40].max() < 2
    assert spread[:, 40:-40].max() < 2


def test_the_evidence_is_told_in_parts() -> None:
    """By its flow the ground between the legs moves; it matches the static scene, and stands out from nothing."""
    masked = [between(k, 5) for k in range(T)]
    static, mover, apart, alone, share, confidence = evidence(clip(5), 5, 0.2, masked)[2:]
    gap, walker = (inner(of) for of in (between(MIDDLE, 5) & ~legs(MIDDLE, 5), legs(MIDDLE, 5)))
    assert np.median(static[gap]) < 0.3 < np.median(static[walker])
    assert np.median(mover[walker]) < 0.2 < np.median(mover[gap])
    for of in (apart, alone):
        assert np.median(of[gap]) < np.percentile(of[walker], 20) / 2
    assert share[between(MIDDLE, 5)].min() > 0.2 > 0.02 > share[:, :40].max()
    assert confidence == pytest.approx(0.2, abs=1 / 255)
